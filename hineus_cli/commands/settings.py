"""`hineus config` and `hineus presets`."""

from __future__ import annotations

from typing import Annotated

import typer

from hineus_cli.options import ConfigFile, Preset, Sets


def show_config(
    preset: Preset = None,
    config: ConfigFile = None,
    sets: Sets = None,
    describe: Annotated[bool, typer.Option("--describe", help="Describe every setting instead.")] = False,
) -> None:
    """Print the settings as they would be used, as YAML that `--config` takes; or describe them all."""
    from rich.table import Table

    from configs.load import config_yaml, describe_settings, load_config, show_value
    from hineus_cli.console import product

    if not describe:
        typer.echo(config_yaml(load_config(preset, config, sets or ())), nl=False)
        return
    table = Table(header_style="bold")
    table.add_column("setting", no_wrap=True)
    table.add_column("default", overflow="fold", max_width=13)
    table.add_column("meaning", overflow="fold")
    for setting in describe_settings():
        values = f"{setting.type}, {setting.bounds}" if setting.bounds else setting.type
        table.add_row(setting.key, show_value(setting.default), f"{setting.description} ({values})")
    product().print(table)


def presets() -> None:
    """List the presets."""
    from configs.load import preset_names, preset_summary

    for name in preset_names():
        typer.echo(f"{name:<8}{preset_summary(name)}")
