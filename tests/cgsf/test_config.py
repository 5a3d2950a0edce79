"""Configuration: what fits becomes a dataclass, everything else is one line that names the place."""

from dataclasses import dataclass, field
from typing import Literal

import pytest

from cgsf import pipelines
from cgsf.config import from_table, preset_names, read_preset, to_table
from cgsf.errors import InputError


@dataclass(frozen=True)
class Inner:
    weight: float = 1.0

    def __post_init__(self):
        if self.weight < 0:
            raise ValueError("weight must not be negative")


@dataclass(frozen=True)
class Outer:
    steps: int = 3
    exact: bool = True
    kind: Literal["fast", "good"] = "good"
    scales: tuple[float, ...] = (1.0, 0.5)
    size: tuple[int, int] = (4, 5)
    limit: float | None = None
    inner: Inner = field(default_factory=Inner)


def test_values_and_defaults():
    table = {"steps": 7, "kind": "fast", "scales": [1, 0.25, 0.1], "limit": 2, "inner": {"weight": 4}}
    assert from_table(Outer, table) == Outer(7, True, "fast", (1.0, 0.25, 0.1), (4, 5), 2.0, Inner(4.0))
    assert from_table(Outer, {"limit": "none"}).limit is None
    assert from_table(Outer, to_table(Outer(limit=3.0))) == Outer(limit=3.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"stpes": 3}, r"unknown setting solver\.stpes; solver has steps, exact"),
        ({"inner": {"wieght": 1}}, r"unknown setting solver\.inner\.wieght"),
        ({"steps": 2.5}, r"solver\.steps must be a whole number, got 2\.5"),
        ({"steps": True}, r"solver\.steps must be a whole number"),
        ({"exact": 1}, r"solver\.exact must be true or false"),
        ({"kind": "slow"}, r"solver\.kind must be one of 'fast', 'good'"),
        ({"scales": 1.0}, r"solver\.scales must be a list"),
        ({"scales": ["a"]}, r"solver\.scales must be a number"),
        ({"size": [1, 2, 3]}, r"solver\.size must have 2 values"),
        ({"limit": "much"}, r"solver\.limit must be a number"),
        ({"inner": 3}, r"solver\.inner must be a table"),
        ({"inner": {"weight": -1}}, r"solver\.inner: weight must not be negative"),
    ],
)
def test_what_does_not_fit(table, message):
    with pytest.raises(InputError, match=message) as caught:
        from_table(Outer, table, "solver")
    assert "\n" not in str(caught.value)


def test_presets_that_ship_fit_every_method():
    assert {"default", "fast", "paper"} <= set(preset_names())
    for preset in preset_names():
        for method in pipelines.METHODS:
            pipelines.load_config(method, preset)


def test_a_preset_of_ones_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[opencv]\ndisparities = 64\n")
    config = pipelines.load_config("opencv-wls-rlof", str(path))
    assert (config.disparities, config.flow, config.filtered) == (64, "rlof", True)
    path.write_text("[opnecv]\n")
    with pytest.raises(InputError, match="unknown table 'opnecv'"):
        pipelines.load_config("opencv", str(path))
    path.write_text("[opencv\n")
    with pytest.raises(InputError, match="TOML"):
        read_preset(str(path))
    with pytest.raises(InputError, match="no such preset"):
        read_preset(str(tmp_path / "none.toml"))
    with pytest.raises(InputError, match="there are default, fast"):
        read_preset("best")
