"""Reads and writes cameras as JSON, OpenCV YAML and ROS CameraInfo."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from transforms3d.axangles import axangle2mat

from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.pictures.camera_conventions import (
    Convention,
    Direction,
    horizontal_fov,
    intrinsic_of,
    make_pose,
    matrix_of,
    opencv_extrinsic,
    opengl_model_matrix,
    pose_from_matrix,
    pose_in_env,
    vertical_fov,
)

Floats = NDArray[np.float64]

FORMAT = "workbench-cameras"
MAX_CHARACTERS = 100_000
MAX_YAML_CHARACTERS = 20_000
"""Maximum number of characters of a YAML text. A calibration has about 2,000. Python's YAML parser takes 20
ms for 1,000."""
# ManiSkill's `intrinsic_cv` counts pixels from the outer edge of the first pixel (the middle of a picture is
# W / 2), but OpenCV's calibration counts from the first pixel's centre. Exported files name every convention,
# since an ``extrinsic`` without a named convention may be any of four matrices.
PIXELS = "pixels from the outer edge of the top left pixel; OpenCV's own calibration gives half a pixel less"
CONVENTIONS = {
    "length": "metres",
    "quaternion": "w x y z; the camera looks along x, y is to its left, z is up (ManiSkill, SAPIEN, ROS bodies)",
    "extrinsic_opencv": "3 x 4, env to camera; the camera has x right, y down, z forward",
    "model_matrix_opengl": "4 x 4, camera to env; the camera has x right, y up, z backward",
    "intrinsic": PIXELS,
    "fov": "radians",
}


@dataclass(frozen=True)
class CameraToExport:
    """A camera to export, at one moment of one env."""

    key: CameraKey
    settings: CameraSettings
    mount: str | None = None
    """Body that the camera is mounted on; None if it is fixed."""
    mount_pose: ArrayLike | None = None
    """(7,) pose of the `mount` in the env's frame."""

    @property
    def pose_in_env(self) -> Floats:
        """(7,) pose in the env's frame.

        Raises:
            ValueError: the camera is mounted, and `mount_pose` is not given.
        """
        if self.mount is not None and self.mount_pose is None:
            raise ValueError(f"camera {self.key[1]!r} is mounted on {self.mount}: mount_pose is needed")
        return pose_in_env(self.settings, self.mount_pose)


@dataclass(frozen=True)
class FoundPose:
    """A matrix in a text that may be a camera's pose.

    A matrix does not contain its convention: camera to world and world to camera both look plausible, as do the three
    conventions of camera axes. So the user has to choose direction and axes, unless the text is our own JSON,
    which names them.
    """

    label: str
    """Path of the matrix in the text, shown to the user."""
    matrix: Floats
    """(4, 4) matrix."""
    stated: tuple[Convention, Direction] | None = None
    """Convention and direction, if the text names them; None if the user must choose."""


# --- export ------------------------------------------------------------------------------------------------------


def cameras_as_json(cameras: Sequence[CameraToExport]) -> str:
    """All cameras with all numbers and conventions, as JSON."""
    entries = []
    for camera in cameras:
        s, pose = camera.settings, camera.pose_in_env
        k = intrinsic_of(s)
        entries.append(
            {
                "name": camera.key[1],
                "kind": camera.key[0],
                "width": s.width,
                "height": s.height,
                "near": s.near,
                "far": s.far,
                "shader_pack": s.shader_pack,
                "fov_vertical": vertical_fov(k, s.height),
                "fov_horizontal": horizontal_fov(k, s.width),
                "intrinsic": k.tolist(),
                "mount": camera.mount,
                "position_in_mount": list(s.position) if camera.mount else None,
                "quaternion_in_mount": list(s.quaternion) if camera.mount else None,
                "position": pose[:3].tolist(),
                "quaternion": pose[3:].tolist(),
                "extrinsic_opencv": opencv_extrinsic(pose).tolist(),
                "model_matrix_opengl": opengl_model_matrix(pose).tolist(),
            }
        )
    whole = {"format": FORMAT, "version": 1, "conventions": CONVENTIONS, "cameras": entries}
    # One line per row of a matrix.
    text = json.dumps(whole, indent=2, allow_nan=False)
    return re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda m: "[" + re.sub(r",\s+", ", ", m[1]) + "]", text) + "\n"


def cameras_as_opencv_yaml(cameras: Sequence[CameraToExport]) -> str:
    """YAML for ``cv2.FileStorage``: one map per camera, keyed by kind and name."""
    lines = ["%YAML:1.0", "---", f"# Metres; {PIXELS}."]
    for camera, key in zip(cameras, _opencv_keys(cameras), strict=True):
        s, pose = camera.settings, camera.pose_in_env
        lines += [f"{key}:", f"   image_width: {s.width}", f"   image_height: {s.height}"]
        if camera.mount:
            lines += [f"   # Mounted on {_one_line(camera.mount)}: the pose holds for one moment only."]
        lines += _opencv_matrix("camera_matrix", intrinsic_of(s))
        lines += _opencv_matrix("distortion_coefficients", np.zeros((1, 5)))
        lines += ["   # World to camera: x right, y down, z forward."]
        lines += _opencv_matrix("extrinsic", opencv_extrinsic(pose))
        lines += ["   # Camera to world, the same camera axes."]
        lines += _opencv_matrix("camera_to_world", matrix_of(pose, "opencv", "camera_to_world"))
    return "\n".join(lines) + "\n"


def camera_as_ros_yaml(camera: CameraToExport) -> str:
    """ROS CameraInfo of one camera, for ``camera_calibration_parsers`` and ``camera_info_manager``.

    CameraInfo has no extrinsic: the pose of the optical frame is in a comment, for ``static_transform_publisher``.
    """
    s, pose = camera.settings, camera.pose_in_env
    k = intrinsic_of(s)
    optical = pose_from_matrix(matrix_of(pose, "opencv", "camera_to_world"), "maniskill", "camera_to_world")
    x, y, z, qw, qx, qy, qz = (_number(v) for v in optical)
    lines = [
        f"# Optical frame in the env's frame: --x {x} --y {y} --z {z} --qx {qx} --qy {qy} --qz {qz} --qw {qw}",
        f"# Camera matrix: {PIXELS}.",
        f"image_width: {s.width}",
        f"image_height: {s.height}",
        f"camera_name: {json.dumps(camera.key[1])}",
    ]
    lines += _ros_matrix("camera_matrix", k)
    lines += ["distortion_model: plumb_bob"]
    lines += _ros_matrix("distortion_coefficients", np.zeros((1, 5)))
    lines += _ros_matrix("rectification_matrix", np.eye(3))
    lines += _ros_matrix("projection_matrix", np.hstack([k, np.zeros((3, 1))]))
    return "\n".join(lines) + "\n"


def _opencv_keys(cameras: Sequence[CameraToExport]) -> list[str]:
    """Valid keys for OpenCV: they begin with a letter and contain letters, digits, - and _."""
    keys: list[str] = []
    for camera in cameras:
        key = re.sub(r"[^A-Za-z0-9_-]", "_", f"{camera.key[0]}_{camera.key[1]}")
        while key in keys:
            key += "_"
        keys.append(key)
    return keys


def _opencv_matrix(name: str, matrix: Floats) -> list[str]:
    rows, columns = matrix.shape
    data = ", ".join(_number(v) for v in matrix.ravel())
    return [
        f"   {name}: !!opencv-matrix",
        f"      rows: {rows}",
        f"      cols: {columns}",
        "      dt: d",
        f"      data: [ {data} ]",
    ]


def _ros_matrix(name: str, matrix: Floats) -> list[str]:
    rows, columns = matrix.shape
    data = ", ".join(_number(v) for v in matrix.ravel())
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]


def _number(value: float) -> str:
    """A number with a decimal point, since YAML 1.1 reads 1e-08 as a string."""
    text = repr(float(value) + 0.0)
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


def _one_line(text: str) -> str:
    return " ".join(text.split())


# --- import ------------------------------------------------------------------------------------------------------


def find_poses(text: str) -> tuple[FoundPose, ...]:
    """Candidates for a camera's pose in untrusted text: our JSON, other JSON or YAML, or a pasted matrix.

    Searches nested maps and lists for 4 x 4 and 3 x 4 matrices, and for pairs of a rotation and a translation
    (``rvec`` and ``tvec``, ``R`` and ``t``). `camera_pose` checks that a candidate's rotation is valid.

    Raises:
        ValueError: nothing is found, or the text cannot be read; the message says what was expected.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"the text has {len(text)} characters; a camera's pose takes a few hundred")
    stripped = text.strip().lstrip("\ufeff")
    if not stripped:
        raise ValueError("there is nothing to read: paste a 4 x 4 matrix, or choose a JSON or YAML file")
    tree = _parsed(stripped)
    if isinstance(tree, Mapping) and tree.get("format") == FORMAT:
        found = list(_workbench_poses(tree))
    else:
        try:
            found = list(_search(tree, ""))
        except RecursionError:
            raise ValueError("the text is nested too deeply to be a calibration") from None
    if not found:
        raise ValueError(
            "the text has no pose: expected a matrix of 4 x 4 or 3 x 4 numbers, or a rotation with a "
            "translation (rvec and tvec, or R and t)"
        )
    return tuple(found)


def camera_pose(
    found: FoundPose,
    convention: Convention | None = None,
    direction: Direction | None = None,
    metres_per_unit: float = 1.0,
) -> Floats:
    """(7,) pose of the camera in the env's frame or, if the calibration is relative to the camera's mount, in
    the frame of the mount.

    Args:
        convention: camera axes of the calibration. Required unless the text names them.
        direction: direction of the matrix, camera to world or world to camera. Required unless the text names it.
        metres_per_unit: unit of the translation; 0.001 for millimetres. Ignored if the text names its convention.

    Raises:
        ValueError: a required argument is missing, or the matrix is not a rotation.
    """
    if found.stated is not None:
        (convention, direction), metres_per_unit = found.stated, 1.0
    if convention is None or direction is None:
        raise ValueError(
            "choose the direction of the matrix and its camera axes: the text does not name them"
        )
    if not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise ValueError(f"a unit of length is a positive number of metres, not {metres_per_unit}")
    matrix = found.matrix.copy()
    matrix[:3, 3] *= metres_per_unit
    return pose_from_matrix(matrix, convention, direction)


class _CalibrationLoader(yaml.SafeLoader):
    """Loads plain YAML data and OpenCV's matrices; constructs no objects."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        # Nine lines of nested aliases expand to a billion leaves, and an alias to itself never ends.
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("a YAML alias (*name) is not read here: write the value out")
        return super().compose_node(parent, index)


def _opencv_map(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix is a map of rows, cols, dt and data")
    return loader.construct_mapping(node, deep=True)


_CalibrationLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_map)

_WORDS = re.compile(r"\b(?:np|numpy|torch)\.|\b(?:array|tensor|matrix|asarray)\b|,?\s*dtype\s*=\s*[\w.]+")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def _parsed(text: str) -> Any:
    if text[0] in "{[":
        try:
            return json.loads(text)
        except (ValueError, RecursionError) as error:
            if text[0] == "{":
                raise ValueError(f"the text begins like JSON but is not valid: {error}") from None
    bare = _WORDS.sub(" ", text)
    if not re.sub(r"[\s,;|()\[\]]", "", _NUMBER.sub("", bare)):
        return _pasted([float(number) for number in _NUMBER.findall(bare)])
    if len(text) > MAX_YAML_CHARACTERS:
        raise ValueError(
            f"{len(text)} characters are too many for YAML; paste only the calibration, some two thousand"
        )
    # OpenCV's first line has a colon where YAML has a space.
    try:
        tree = yaml.load(re.sub(r"\A%YAML.*\n", "", text), Loader=_CalibrationLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(
            f"the text is neither YAML nor a matrix of numbers: {_one_line(str(error))}"
        ) from None
    if not isinstance(tree, (Mapping, list)):
        raise ValueError("the text is neither JSON, nor YAML with named values, nor a matrix of numbers")
    return tree


def _pasted(numbers: list[float]) -> list[list[float]]:
    if len(numbers) not in (12, 16):
        raise ValueError(f"a pose has 4 x 4 or 3 x 4 numbers; the text has {len(numbers)}")
    return [numbers[i : i + 4] for i in range(0, len(numbers), 4)]


def _workbench_poses(tree: Mapping[Any, Any]) -> Iterator[FoundPose]:
    cameras = tree.get("cameras")
    for camera in cameras if isinstance(cameras, list) else []:
        if not isinstance(camera, Mapping):
            continue
        position, quaternion = _array(camera.get("position")), _array(camera.get("quaternion"))
        if position is None or quaternion is None or position.shape != (3,) or quaternion.shape != (4,):
            continue
        pose = make_pose(position, quaternion)
        label = f"{camera.get('kind', 'camera')} {camera.get('name', '')}"
        matrix = matrix_of(pose, "maniskill", "camera_to_world")
        yield FoundPose(_one_line(label), matrix, ("maniskill", "camera_to_world"))


_ROTATIONS = ("rvec", "rotation_vector", "r", "rotation", "rotation_matrix", "rot", "rot_mat", "rmat")
_TRANSLATIONS = ("tvec", "translation_vector", "t", "translation", "trans", "position", "tvecs")
_NO_POSE = ("projection_matrix", "p", "p1", "p2", "q")
"""Names of 3 x 4 and 4 x 4 matrices that are not poses, in files of ROS and OpenCV's stereo calibration."""


def _search(tree: Any, path: str) -> Iterator[FoundPose]:
    array = _array(tree)
    if array is not None:
        matrix = _as_4x4(array)
        if matrix is not None:
            yield FoundPose(path or "the matrix", matrix)
        return
    if isinstance(tree, Mapping):
        lower = {str(key).lower(): value for key, value in tree.items()}
        rotation = _first(lower, _ROTATIONS, _rotation)
        translation = _first(lower, _TRANSLATIONS, _translation)
        if rotation is not None and translation is not None:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation, translation
            yield FoundPose(
                f"{path}: rotation and translation" if path else "rotation and translation", matrix
            )
        for key, value in tree.items():
            if str(key).lower() not in _NO_POSE:
                yield from _search(value, f"{path} / {_one_line(str(key))}" if path else _one_line(str(key)))
    elif isinstance(tree, list):
        for i, value in enumerate(tree):
            yield from _search(value, f"{path} / {i}" if path else str(i))


def _first(values: Mapping[str, Any], names: Sequence[str], read: Any) -> Floats | None:
    for name in names:
        array = _array(values.get(name))
        made = None if array is None else read(array)
        if made is not None:
            return made
    return None


def _array(value: Any) -> Floats | None:
    """An array from a list of numbers, a list of rows, or a map of rows, cols and data; None for other values."""
    if isinstance(value, Mapping) and {"rows", "cols", "data"} <= set(value):
        data = _array(value["data"])
        rows, columns = value["rows"], value["cols"]
        fits = data is not None and all(isinstance(n, int) and 0 < n < 1000 for n in (rows, columns))
        return (
            data.reshape(rows, columns) if data is not None and fits and data.size == rows * columns else None
        )
    if not isinstance(value, list) or not value:
        return None
    nested = [row for row in value if isinstance(row, list)]
    if nested and (len(nested) < len(value) or len({len(row) for row in nested}) > 1):
        return None
    flat = [number for row in nested for number in row] if nested else value
    try:
        # YAML 1.1 reads 1e-08 as a string; booleans and None are not numbers.
        numbers = [float(n) for n in flat if isinstance(n, (int, float, str)) and not isinstance(n, bool)]
    except (ValueError, OverflowError):
        return None
    if len(numbers) < len(flat):
        return None
    return np.array(numbers).reshape(len(nested), -1) if nested else np.array(numbers)


def _as_4x4(array: Floats) -> Floats | None:
    if array.shape in ((12,), (16,)):
        array = array.reshape(-1, 4)
    if array.shape == (4, 4):
        return array
    return np.vstack([array, [0.0, 0.0, 0.0, 1.0]]) if array.shape == (3, 4) else None


def _translation(array: Floats) -> Floats | None:
    return array.ravel() if array.size == 3 else None


def _rotation(array: Floats) -> Floats | None:
    """(3, 3) rotation of a matrix, or of OpenCV's rotation vector (Rodrigues: axis times angle)."""
    if array.size == 9:
        return array.reshape(3, 3)
    if array.size != 3:
        return None
    angle = float(np.linalg.norm(array))
    return np.eye(3) if angle == 0 else axangle2mat(array.ravel() / angle, angle, is_normalized=True)
