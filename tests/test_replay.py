"""The command that runs again is taken back by the settings' own loader, and by a shell."""

from __future__ import annotations

import shlex

import pytest

from configs.load import load_config, preset_names
from configs.replay import replay_command, settings_beyond


@pytest.mark.parametrize("preset", preset_names())
def test_a_preset_alone_needs_no_settings(preset):
    assert settings_beyond(preset, load_config(preset)) == []


@pytest.mark.parametrize(
    "sets",
    [
        ["train.steps=77", "export.formats=[glb, stl]", "place.known_distance=0 0 0 1 0 0 2.5"],
        ["train.backbone=neuralangelo"],
        ["ingest.leave_out=[größe 😀.jpg, 'it''s']"],
        ["train.backbone=neus2", "train.density.form=laplace", "train.minutes=1.5"],
        [
            "sfm.deterministic=true",
            "train.density.scale_end=1e-5",
            "train.terms.ambiguity.form=off",
            "place.region=box 0 0 0 1 1 2",
        ],
    ],
)
def test_what_differs_from_the_preset_gives_the_settings_back(sets):
    config = load_config("tiny", sets=sets)
    assert load_config("tiny", sets=settings_beyond("tiny", config)) == config


def test_the_command_survives_a_shell():
    sources = {"photos": "/a b/it's", "masks": "/m", "poses": None}
    config = load_config("gpu", sets=["export.formats=[glb]"])
    words = shlex.split(replay_command(sources, "gpu", config, "again"))
    assert words[:7] == ["hineus", "run", "/a b/it's", "--preset", "gpu", "--workspace", "again"]
    assert words[7:9] == ["--masks", "/m"]
    assert "--poses" not in words
    assert load_config("gpu", sets=words[words.index("--set") + 1 :: 2]) == config


def test_a_preset_that_is_gone_is_spelled_out_over_cpu():
    config = load_config("tiny")
    words = shlex.split(replay_command({"photos": "p"}, "gone", config, "again"))
    assert words[4] == "cpu"
    assert load_config("cpu", sets=words[words.index("--set") + 1 :: 2]) == config
