"""What the Tab key offers as an option's value. Heavy imports are inside: the shell asks on each press."""

from __future__ import annotations


def preset_names(incomplete: str) -> list[str]:
    from configs.load import preset_names

    return _starting(incomplete, preset_names())


def stage_names(incomplete: str) -> list[str]:
    from stages.pipeline import PIPELINE

    return _starting(incomplete, [stage.name for stage in PIPELINE])


def devices(incomplete: str) -> list[str]:
    return _starting(incomplete, ["auto", "cpu", "cuda"])


def lights(incomplete: str) -> list[str]:
    from stages.light.built_in import LIGHTS

    return _starting(incomplete, ["learned", *LIGHTS])


def rendered_subjects(incomplete: str) -> list[str]:
    from stages.render import SUBJECTS

    return _starting(incomplete, list(SUBJECTS))


def setting_keys(incomplete: str) -> list[str]:
    """Keys with the equals sign; behind it the values, of settings that have few."""
    from configs.load import describe_settings

    key, equals, _ = incomplete.partition("=")
    if not equals:
        return _starting(incomplete, [f"{setting.key}=" for setting in describe_settings()])
    values = next((setting.type.split(" | ") for setting in describe_settings() if setting.key == key), [])
    return _starting(incomplete, [f"{key}={value}" for value in values]) if len(values) > 1 else []


def _starting(start: str, words: list[str]) -> list[str]:
    return [word for word in words if word.startswith(start)]
