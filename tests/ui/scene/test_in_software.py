from __future__ import annotations

import numpy as np

from tests.ui.scenes import table_scene
from workbench.ui.scene.env_grid import lay_out
from workbench.ui.scene.in_software import pixel_of
from workbench.ui.scene.pixels import Eye


def test_a_pixel_is_that_of_the_nearest_env_and_eye() -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    above = np.array([0.0, 0.0, layout.high[2] + 2.0])
    far = Eye(above + layout.offsets[0] + [0, 0, 3], 0.001)
    near = Eye(above + layout.offsets[3], 0.001)
    assert np.isclose(pixel_of((far,), layout, alone=False), 0.005)
    assert np.isclose(pixel_of((far, near), layout, alone=False), 0.002)
    # One env alone stands at the origin, whichever it is.
    assert np.isclose(pixel_of((Eye(above, 0.001),), layout, alone=True), 0.002)
