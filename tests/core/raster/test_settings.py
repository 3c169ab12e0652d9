"""Settings of the rasterizer outside their range are named when they are made."""

import dataclasses
import math

import pytest

from r5dgs_core.raster import RasterSettings

NAMES = [field.name for field in dataclasses.fields(RasterSettings)]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_a_setting_that_is_not_finite_is_named(name, value):
    with pytest.raises(ValueError, match=rf"^raster settings: {name}: expected a finite number, got {value}$"):
        RasterSettings(**{name: value})


@pytest.mark.parametrize(
    ("name", "below", "lowest", "highest", "above"),
    [
        ("near_plane", 0.0, 1e-30, 1e30, None),
        ("dilation", 0.0099, 0.01, 1e6, None),
        ("frustum_slack", -0.1, 0.0, 1e6, None),
        ("alpha_min", 0.9e-4, 1e-4, 0.98, 0.99),
        ("alpha_max", 1 / 255, 0.01, 0.999, 1.0),
        ("transmittance_min", 0.9e-30, 1e-30, 0.999, 1.0),
        ("id_alpha_min", -0.1, 0.0, 1.0, 1.1),
    ],
)
def test_each_setting_has_its_range(name, below, lowest, highest, above):
    for value in (lowest, highest):
        assert getattr(RasterSettings(**{name: value}), name) == value
    for value in (below, above):
        if value is not None:
            with pytest.raises(ValueError, match=r"^raster settings: \w+: expected .*, got ") as caught:
                RasterSettings(**{name: value})
            assert name in str(caught.value)
