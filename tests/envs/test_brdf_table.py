"""The BRDF lookup table that our cameras load equals the one that SAPIEN computes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import sapien
import sapien.render
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack

from tests.drive.render_device import RENDER_DEVICE
from workbench.envs import backends
from workbench.envs.backends import give_brdf_table

SHADERS = Path(sapien.__file__).parent / "vulkan_shader"
DRAWN = "outColor.rgb = mix(bg, color.rgb, color.a);"
FILE = Path(backends.__file__).parent / "brdf_table.npz"


@pytest.mark.slow
def test_the_table_equals_sapiens_bit_for_bit(tmp_path: Path, renderer: None) -> None:
    """A shader renders the table. ``WORKBENCH_RENEW=1`` writes it into our file."""
    for pack in ("minimal", "common"):
        shutil.copytree(SHADERS / pack, tmp_path / pack)
    shader = tmp_path / "minimal" / "composite0.frag"
    text = shader.read_text()
    assert text.count(DRAWN) == 1
    # Keep the stock colour in the sum, or the compiler drops its textures and the renderer fails without them.
    drawn = f"{DRAWN}\n  outColor.rgb = outColor.rgb * 1e-30 + texture(samplerBRDFLUT, inUV).rgb;"
    shader.write_text(text.replace(DRAWN, drawn))
    scene = sapien.Scene(
        [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(sapien.Device(RENDER_DEVICE))]
    )
    before = sapien.render.get_camera_shader_dir()
    # Float textures: an earlier camera of this process may have set a pack with byte textures.
    set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])
    sapien.render.set_camera_shader_dir(str(tmp_path / "minimal"))
    try:
        theirs, ours = (scene.add_camera(name, 512, 512, 1.0, 0.01, 10.0) for name in ("theirs", "ours"))
    finally:
        sapien.render.set_camera_shader_dir(before)
    scene.update_render()
    theirs.take_picture()
    computed = theirs.get_picture("Color")[..., :2]
    assert 1 < computed.max() < 2
    if os.environ.get("WORKBENCH_RENEW"):
        bits = np.moveaxis(computed.astype(np.float16), 2, 0).copy().view(np.uint16)
        np.savez_compressed(FILE, steps=np.diff(bits, axis=2, prepend=np.uint16(0)))
    give_brdf_table(ours)
    ours.take_picture()
    assert np.array_equal(ours.get_picture("Color")[..., :2], computed)
