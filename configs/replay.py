"""The command that runs the same photos with the same settings again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping

from configs.dotted import flatten
from configs.load import load_config, preset_names
from configs.params import Config

OPTIONS = {"masks": "--masks", "poses": "--poses", "control points": "--control", "light": "--light"}


def replay_command(sources: Mapping[str, str | None], preset: str | None, config: Config, workspace: str) -> str:
    """`hineus run ...`, quoted for a shell, into a new workspace.

    Args:
        sources: "photos", "masks", "poses", "control points" and "light" -> path, None where not given.
        preset: the settings started from it; one that is not known (any more) is replaced by `cpu`.
        config: all settings; those that the preset does not give are spelled out.
        workspace: folder of the new run.
    """
    base = preset if preset in preset_names() else "cpu"
    assert base is not None
    words = ["hineus", "run", sources.get("photos") or "PHOTOS", "--preset", base, "--workspace", workspace]
    for name, option in OPTIONS.items():
        if path := sources.get(name):
            words += [option, path]
    for setting in settings_beyond(base, config):
        words += ["--set", setting]
    return shlex.join(words)


def settings_beyond(preset: str, config: Config) -> list[str]:
    """What `--set` must say on top of a preset for `load_config` to give these settings, "section.key=value" each."""
    backbone = []
    if load_config(preset).train.backbone != config.train.backbone:  # it brings settings of its own
        backbone = [f"train.backbone={config.train.backbone}"]
    given, wanted = (
        flatten(settings.model_dump(mode="json")) for settings in (load_config(preset, sets=backbone), config)
    )
    return backbone + [
        f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in wanted.items() if value != given[key]
    ]
