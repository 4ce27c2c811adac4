"""`python -m hineus_cli` is `hineus`: starts the command line once it is sure that it gets its own modules."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """The `hineus` command."""
    if other := shadowed(Path(__file__).parents[1]):
        sys.exit(
            f"Error: {other!r} is found instead of our part of the same name.\n"
            "Leave that folder or PYTHONPATH, or install in an environment of its own: `uv tool install hineus`."
        )
    try:
        from hineus_cli.app import main as run

        run()
    except KeyboardInterrupt:  # before the commands, which say more, can take it
        sys.exit(130)


def shadowed(home: Path) -> str | None:
    """Where a package lies that Python takes for one of ours, since they have common names; None where none does."""
    for name in ("stages", "configs"):
        spec = find_spec(name)
        places = [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
        if not any(place.resolve() == (home / name).resolve() for place in places):
            return str(places[0] if places else (spec and spec.origin) or f"no package {name}")
    return None


if __name__ == "__main__":
    main()
