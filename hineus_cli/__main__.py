"""`python -m hineus_cli` is `hineus`: starts the command line once it is sure that it gets its own modules."""

from __future__ import annotations

# No others before `leave_current_folder`: they would come from there.
import os
import sys

HOME = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def main() -> None:
    """The `hineus` command."""
    leave_current_folder()
    from hineus_cli.at_once import end_at_once_by_signals
    from hineus_cli.supervising import supervised

    end_at_once_by_signals()
    supervised(_run)


def _run() -> None:
    if other := shadowed(HOME):
        sys.exit(
            f"Error: {other!r} is found instead of our part of the same name.\n"
            "Leave that folder or PYTHONPATH, or install in an environment of its own: `uv tool install hineus`."
        )
    from hineus_cli.at_once import sent_by_ourselves, signals_wait

    _bound_threads()
    with signals_wait():  # libraries start threads
        from hineus_cli.app import main as run
        from stages.engine.shortage import too_many_threads

        if sent_by_ourselves():  # by OpenBLAS, where it gets no thread
            short = too_many_threads("This command")
            sys.stderr.write(f"Error: {short.message}\n{short.hint}\n")
            sys.exit(short.exit_code)
    run()


def _bound_threads() -> None:
    """Tell libraries of a container's quota of cores, before they start a thread for each core of the machine."""
    from stages.limits import available_cores

    cores = available_cores()
    if cores < (os.cpu_count() or 1):
        for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
            os.environ.setdefault(variable, str(cores))


def leave_current_folder() -> None:
    """Find no modules in the current folder, which may be full of somebody else's files.

    `python -m` puts it into the path, and so does an empty entry of PYTHONPATH. It stays where it is named there in
    full, or where we or Python lie in it.
    """
    try:
        here = os.path.realpath(os.getcwd())
    except OSError:  # it was deleted
        here = ""
    pythons = (os.path.realpath(prefix) + os.sep for prefix in (sys.prefix, sys.base_prefix))
    if here == os.path.realpath(HOME) or (here + os.sep).startswith(tuple(pythons)):
        return
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:] = [
        place for place in sys.path if os.path.isabs(place) and (place in named or os.path.realpath(place) != here)
    ]


def shadowed(home: str) -> str | None:
    """Where a package lies that Python takes for one of ours, since they have common names; None where none does."""
    from importlib.util import find_spec
    from pathlib import Path

    for name in ("stages", "configs"):
        spec = find_spec(name)
        places = [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
        if not any(place.resolve() == (Path(home) / name).resolve() for place in places):
            return str(places[0] if places else (spec and spec.origin) or f"no package {name}")
    return None


if __name__ == "__main__":
    main()
