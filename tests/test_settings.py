"""Each default stands once: what a command offers is what its stage's Config says, and messages name the command's options."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
from types import SimpleNamespace
from typing import get_type_hints

import cv2
import numpy as np
import pytest

from lunargr_cli import commands, spelling
from lunargr_cli.options import join_numbers, parse_shard, read_names, read_parameters
from schemas.errors import ConfigError

MODULES = {
    m.name: importlib.import_module(f"lunargr_cli.commands.{m.name}") for m in pkgutil.iter_modules(commands.__path__)
}
# Commands whose options are a stage's settings, and where these are.
CONFIGS = {
    "albedo": "albedo", "compare": "train", "convert": "convert", "diagnose": "diagnose", "evaluate": "evaluate",
    "export": "export", "infer": "infer", "ingest": "ingest", "match": "match", "merge": "merge", "project": "project",
    "refine": "refine", "render": "render", "report": "report", "sample": "sample", "train": "train", "view": "view",
}  # fmt: skip
# How commands write what a Config holds as a tuple.
WRITTEN = {
    "widths": join_numbers, "dropout": join_numbers, "shard": lambda shard: None if shard == parse_shard(None) else shard,
    **dict.fromkeys(("maps", "only", "leave_out", "free"), lambda names: names or None),
    "size_px": lambda size: ",".join(map(str, size)), "parameters": lambda values: values or None, "export": lambda kinds: kinds or None,
}  # fmt: skip
# Of the same name, but not the setting: where the GeoTIFF goes, not whether; left away for the stage's own choice.
OTHERS = {
    ("infer", "geotiff"), ("albedo", "geotiff"), ("refine", "geotiff"), ("match", "matchers"),
    *(("render", name) for name in ("view", "roll_deg", "fov_deg", "size_px")),
}  # fmt: skip
# What commands have beside settings.
BESIDE = {
    "output", "overwrite", "resume", "quiet", "json_file", "figures", "report", "scheduler", "parts", "no_geotiff", "models",
    "seeds", "list_effects", "list_matchers", "files", "shifts", "calibration", "dem", "trajectory", "stereo", "altitude", "convergence", "pairs",
    "images", "seed", "checkpoint", "source", "split", "body",
}  # fmt: skip


def options(command):
    for name, parameter in inspect.signature(command).parameters.items():
        if parameter.default is not inspect.Parameter.empty:
            yield name, parameter.default


def defaults(config) -> dict:
    fields = dataclasses.fields(config)
    return {f.name: f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default for f in fields}


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_a_command_s_defaults_are_those_of_its_config(name):
    known = defaults(importlib.import_module(f"stages.{CONFIGS[name]}").Config)
    seen = 0
    for option, default in options(MODULES[name].command):
        if option not in known:
            assert option in BESIDE, f"{name}: {option} is no field of {CONFIGS[name]}.Config"
        elif (name, option) not in OTHERS:
            split = lambda shares: "/".join(f"{100 * share:g}" for share in shares)  # noqa: E731
            written = WRITTEN.get(option, split if (name, option) == ("sample", "split") else lambda value: value)
            assert default == written(known[option]), f"{name}: {option}"
            seen += 1
    assert seen


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_defaults_are_not_written_down_a_second_time(name):
    """A number, word or True as a default stands in the Config alone."""
    source = inspect.getsource(MODULES[name].command)
    known = defaults(importlib.import_module(f"stages.{CONFIGS[name]}").Config)
    for option, default in options(MODULES[name].command):
        if option in known and default not in (None, False):
            assert f"= {default!r},\n" not in source.replace("'", '"').replace('"', "'"), f"{name}: {option}"


def test_simulate_shows_the_defaults_of_its_recipe():
    from stages.simulate import Config

    hints = get_type_hints(MODULES["simulate"].command, include_extras=True)
    for name in ("size_px", "images", "units", "seed"):
        assert f"[default: {getattr(Config, name)}]" in hints[name].__metadata__[0].help


def test_settings_are_spelled_as_the_options_of_the_command_that_runs():
    before = spelling.running.set(MODULES["render"].command)
    try:
        assert (
            spelling.spell("`fov_deg`: too wide; lower `size_px`, see `a b`")
            == "--fov: too wide; lower --size, see `a b`"
        )
        assert spelling.spell("run 'lunargr albedo' with `leave_out`") == "run 'lunargr albedo' with --leave-out"
    finally:
        spelling.running.reset(before)


@pytest.mark.parametrize("text", ["", ",", "w,", "w,,b", " "])
def test_a_list_of_names_has_no_empty_ones(text):
    with pytest.raises(ConfigError, match=r"^--maps: expected names separated by commas, found '[^\n]*; leave"):
        read_names("--maps", text)


def test_lists_of_options_name_each_thing_once(tmp_path):
    """Whichever came last would win, or everything would count twice."""
    from stages.evaluate.held_out_images import _check_once
    from stages.match.comparisons import from_images
    from stages.simulate.hidden import hidden_from_option

    assert read_names("--maps", "w, b") == ("w", "b") and read_names("--maps", None) == ()
    assert read_parameters(["w=0.2", "b=0.3,c=1"]) == {"w": 0.2, "b": 0.3, "c": 1.0}
    first, copy = tmp_path / "a.png", tmp_path / "b.png"
    cv2.imwrite(str(first), np.arange(256, dtype=np.uint8).reshape(16, 16))
    copy.write_bytes(first.read_bytes())
    for call in (
        lambda: read_names("--maps", "w,b,w"),
        lambda: read_parameters(["w=0.2", "w=0.3"]),
        lambda: MODULES["compare"]._models("M1,m1"),
        lambda: hidden_from_option("echo:lag_px=3,lag_px=5"),
        lambda: _check_once([first, copy]),
        lambda: from_images(first, [copy, copy]),
    ):
        with pytest.raises(ConfigError, match="once"):
            call()


def test_lists_fit_what_they_are_for():
    from stages import train
    from stages.albedo.config import used_frames
    from stages.train.checks import check

    frames = [SimpleNamespace(image_id=f"IMG{k}") for k in range(4)]
    config = importlib.import_module("stages.albedo").Config
    assert used_frames(frames, config(fold=(3, 9))) == [True, True, True, False]
    with pytest.raises(ConfigError, match=r"`fold`: expected one of the first 4 folds.*found 5/9"):
        used_frames(frames, config(fold=(4, 9)))
    check(train.Config(widths=(4, 8, 8), dropout=(0.1,)))
    with pytest.raises(ConfigError, match="`dropout`: expected one share, or 3 for as many `widths`, found 2"):
        check(train.Config(widths=(4, 8, 8), dropout=(0.1, 0.2)))
