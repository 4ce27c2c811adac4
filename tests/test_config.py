"""Settings: the order of the layers, the sentences of refusal, the presets, the descriptions."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import yaml

from configs.dotted import flatten
from configs.load import config_yaml, describe_settings, load_config, preset_names, preset_summary, preset_text
from configs.params import Config
from configs.renames import REMOVED, RENAMED, section_with_new_names
from configs.replay import settings_beyond
from stages.errors import ConfigError


def test_order_is_defaults_preset_file_set(tmp_path: Path) -> None:
    tiny = load_config("tiny")
    assert tiny.extract.resolution != Config().extract.resolution
    assert tiny.sfm.matcher == Config().sfm.matcher
    file = tmp_path / "mine.yaml"
    file.write_text("extract:\n  resolution: 111\natlas:\n  padding: 7\nsfm:\n")
    with_file = load_config("tiny", file)
    assert with_file.extract.resolution == 111
    assert with_file.extract.block == tiny.extract.block  # a file changes only what it names
    with_set = load_config("tiny", file, ["extract.resolution=112", "extract.resolution=113"])
    assert (with_set.extract.resolution, with_set.atlas.padding) == (113, 7)


def test_presets_validate_and_say_what_they_are() -> None:
    assert {"cpu", "gpu", "tiny"} <= set(preset_names())
    for name in preset_names():
        assert isinstance(load_config(name), Config)
        assert preset_text(name).startswith("# ")
        assert len(preset_summary(name)) > 10


def test_every_setting_is_described() -> None:
    settings = describe_settings()
    assert len(settings) > 25
    assert [setting.key for setting in settings if not setting.description or not setting.type] == []
    by_key = {setting.key: setting for setting in settings}
    assert by_key["bake.views"].bounds == ">= 1, <= 32"
    assert by_key["sfm.mapper"].type == "incremental | global | hierarchical"
    assert by_key["train.minutes"].type == "number | null"


def test_yaml_round_trip(tmp_path: Path) -> None:
    config = load_config("tiny", sets=["train.minutes=2.5", "export.formats=[glb]", "place.up=+y"])
    file = tmp_path / "config.yaml"
    file.write_text(config_yaml(config))
    assert load_config(file=file) == config


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("train.minutes=5", 5.0),
        ("train.minutes=null", None),
        ("train.minutes=1e-1", 0.1),
        ("bake.gain=false", False),
        ("export.formats=[glb, ply]", ("glb", "ply")),
        ("place.up=-z", "-z"),
        (" sfm.seed = 3", 3),
    ],
)
def test_set_takes_yaml_values(text: str, expected: Any) -> None:
    section, _, key = text.strip().partition("=")[0].strip().partition(".")
    assert getattr(getattr(load_config(sets=[text]), section), key) == expected


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("sfm.max_feature=1", "Unknown setting `sfm.max_feature` in --set", "Did you mean `sfm.max_features`?"),
        ("max_features=1", "Unknown setting `max_features`", "Did you mean `sfm.max_features`?"),
        ("bake.max_features=500", "Unknown setting `bake.max_features`", "Did you mean `sfm.max_features`?"),
        ("expotr=1", "Unknown setting `expotr`", "Did you mean `export`?"),
        ("qqqq.wwww=1", "Unknown setting `qqqq`", "lists all settings"),
        ("sfm.max_features=3", "`sfm.max_features` = 3 in --set sfm.max_features=3 is out of bounds", ">= 100"),
        ("train.minutes=-1", "`train.minutes` = -1 in", "must be > 0"),
        ("bake.views=many", "`bake.views` = 'many' in", "must be whole number >= 1, <= 32"),
        ("sfm.matcher=off", "`sfm.matcher` = 'off' in", "auto | preemptive | exhaustive"),
        (
            "export.formats=[glb, fbx]",
            "`export.formats` = 'fbx' in",
            "list of (glb | usdz | obj | ply | stl | points | orthophoto)",
        ),
        ("sfm=3", "`sfm` in --set sfm=3 is a section of settings", "`sfm.matcher`"),
        ("sfm.seed", "is not of the form section.key=value", "--set sfm.seed=1"),
        ("sfm.seed=[1", "the value is no YAML of settings", "Quote it"),
    ],
)
def test_refusals_name_the_setting_and_the_way_out(text: str, message: str, hint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=[text])
    assert message in caught.value.message
    assert hint in f"{caught.value.message} {caught.value.hint}"


def test_absent_file_and_unknown_preset(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.yaml cannot be read"):
        load_config(file=tmp_path / "no.yaml")
    with pytest.raises(ConfigError, match="no preset 'tinny'") as caught:
        load_config("tinny")
    assert "Did you mean `--preset tiny`?" in caught.value.hint


BACKBONES = {
    "hineus": ("laplace", "scheduled", "analytic", "hash"),
    "neus2": ("neus", "learned", "analytic", "hash"),
    "hfneus": ("neus", "learned", "analytic", "frequency"),
    "neuralangelo": ("neus", "learned", "numerical", "hash"),
}


@pytest.mark.parametrize("name", BACKBONES)
def test_a_backbone_sets_density_scale_gradients_and_encoding(name):
    train = load_config("cpu", None, [f"train.backbone={name}"]).train
    assert (train.density.form, train.density.scale, train.field.gradients, train.field.encoding) == BACKBONES[name]


@pytest.mark.parametrize("backwards", [False, True])
def test_what_is_named_beside_a_backbone_wins_in_any_order(backwards):
    sets = ["train.backbone=neuralangelo", "train.density.form=laplace"]
    train = load_config("cpu", None, sets[::-1] if backwards else sets).train
    assert (train.density.form, train.field.gradients) == ("laplace", "numerical")


def test_a_backbone_over_a_file_that_states_everything_wins_and_below_it_does_not(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text(config_yaml(load_config("cpu", None, ["train.backbone=neus2", "train.density.form=laplace"])))
    assert load_config(None, file).train.density.form == "laplace"
    assert load_config(None, file, ["train.backbone=neus2"]).train.density.form == "neus"


def test_an_unknown_backbone_is_refused_with_those_there_are():
    with pytest.raises(ConfigError, match=r"hineus \| neus2"):
        load_config("cpu", None, ["train.backbone=../presets/cpu"])


# ---------------------------------------------------------------- files and values that are no settings
HUGE = "9" * 5000


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("2020-13-45", "= '2020-13-45' in"),
        ("2020-01-02", "= '2020-01-02' in"),
        ("1:30:00", "= '1:30:00' in"),
        (HUGE, "= inf in"),
        (f"-{HUGE}", "= -inf in"),
        (f"0x{HUGE}", "= '0x9999"),
        (f"'{HUGE}'", "= '9999"),
        ("99999999999999999999999", "is no valid value"),
        (".inf", "= inf in"),
        (".nan", "= nan in"),
        ("1e999", "= inf in"),
        ("1.5", "= 1.5 in"),
        ("true", "it must be a number, not true or false"),
        ("null", "= None in"),
        ("!!bool abc", "tags (tag:yaml.org,2002:bool) are not read here"),
        ("!!int abc", "tags ("),
        ("!!binary AA==", "tags ("),
        ("!!set {a, b}", "tags ("),
        ("!!python/object/apply:os.system [echo]", "tags (tag:yaml.org,2002:python/object/apply:os.system)"),
        ("!<tag:x> 1", "tags (tag:x)"),
        ("&a [*a]", "anchors and aliases"),
        ("&a {x: *a}", "anchors and aliases"),
        ("&a 1", "anchors and aliases"),
        ("{x: 1}", "is a setting, not a section of settings"),
        ("{}", "is a setting, not a section of settings"),
        ("{<<: {x: 1}}", "is a setting, not a section of settings"),
        ("{a: 1, a: 2}", "`a` is there twice"),
        ("{1: 2}", "1 is no name of a setting or section"),
        ("{[a]: 2}", "['a'] is no name of a setting or section"),
        ("{a.b: 2}", "'a.b' is no name of a setting or section"),
        ("[" * 6000 + "]" * 6000, "more than 8 deep in each other"),
        ("[" * 50_000, "more than 8 deep in each other"),
        ("{a: " * 6000 + "}" * 6000, "more than 8 deep in each other"),
        ("[" + "x," * 10_000 + "]", "= ['x', 'x', "),
        ("x" * 100_000, "= 'xxx"),
    ],
    ids=lambda text: text[:20],
)
def test_values_that_are_none_are_refused_in_a_short_sentence(tmp_path: Path, value: str, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"sfm:\n  seed: {value}\n")
    for given in ({"sets": [f"sfm.seed={value}"]}, {"file": file}):
        with pytest.raises(ConfigError) as caught:
            load_config(**given)
        assert message in caught.value.message
        assert len(caught.value.message) < 1000


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"sfm:\n  sed: 1\n", "Unknown setting `sfm.sed` in "),
        (b"sfm:\n  seed: -1\n", "out of bounds: it must be >= 0"),
        (b"sfm: [\n", "is no YAML of settings at line"),
        (b"- 1\n", "holds list where sections were expected"),
        (b"sfm:\n  seed: 1\n---\nsfm:\n  seed: 2\n", "found another document"),
        (b"sfm:\n  seed: 1\n  seed: 2\n", "at line 3: `seed` is there twice"),
        (b"sfm: {}\nsfm: {}\n", "`sfm` is there twice"),
        (b"<<: {sfm: {seed: 1}}\n", "Unknown setting `<<`"),
        (b"train: {rays: 5, sampling: {rays: {x: 1}}}\n", "`train.sampling.rays` in"),
        (b"train.rays: 5\ntrain: 3\n", "'train.rays' is no name"),
        (b"null: 1\n", "None is no name"),
        (b"train:\n  backbone: " + b"a" * 3000, "`train.backbone` = 'aaa"),
        (b"train:\n  backbone: [hineus]\n", "`train.backbone` = ['hineus'] in"),
        ("sfm:\n  seed: 1\n".encode("utf-16")[:-1], "truncated data"),
        ("sfm:\n  seed: 1\n".encode("utf-16-be"), "unacceptable character #x0000"),
        (b"sfm: \xff\n", "unacceptable character #xdcff"),
        (b"sfm: \x00\n", "unacceptable character #x0000"),
        (b"\x1b[31m", "unacceptable character #x001b"),
        (b"# " + b"x" * (1 << 18), "at most 262144 are read"),
        (b"sfm\n", "holds str where sections were expected"),
        (b"%YAML 9.9\n--- {}\n", "found incompatible YAML document"),
    ],
    ids=lambda each: each[:20] if isinstance(each, bytes) else "",
)
def test_files_that_are_no_settings_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(file=file)
    assert message in caught.value.message
    assert "mine.yaml" in caught.value.message


@pytest.mark.parametrize(
    "content", ["", "\n", "# nothing\n", "---\n", "\ufeffsfm:\n", "{}", "sfm: null\n", "sfm: {}\n"]
)
def test_files_that_set_nothing_are_fine(tmp_path: Path, content: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(content, encoding="utf-8")
    assert load_config(file=file) == Config()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_files_as_programs_of_windows_write_them(tmp_path: Path, encoding: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_bytes("sfm:\r\n  seed: 3\r\n".encode(encoding))
    assert load_config(file=file).sfm.seed == 3


def test_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "round").symlink_to("round")
    for place, reason in {
        tmp_path: "no file but a folder",
        tmp_path / "pipe": "no file but a folder, a pipe",
        Path("/dev/zero"): "no file but a folder, a pipe",
        tmp_path / "round": "ymbolic link",
        tmp_path / ("a" * 300): "File name too long",
    }.items():
        with pytest.raises(ConfigError, match=reason):
            load_config(file=place)


@pytest.mark.parametrize("text", ["", "=", "=1", ".=1", "sfm.=1", "sfm", ".".join("a" * 5000) + "=1", "a" * 5000])
def test_set_without_a_setting_is_refused(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=[text])
    assert len(caught.value.message) < 1000


def test_every_number_has_bounds_and_what_lies_outside_is_refused() -> None:
    numbers = [setting for setting in describe_settings() if "number" in setting.type]
    assert len(numbers) > 80
    for setting in numbers:
        rules = [rule.split() for rule in setting.bounds.split(", ")]
        assert [sign[0] for sign, _ in rules] == [">", "<"], setting.key
        low, high = (float(bound) for _, bound in rules)
        outside = [low - 1, high + 1, -1e300, 1e300, -(2**63), 2**64, 10**400, "nan", "inf", "-inf", ".inf", ".nan"]
        outside += [bound for sign, bound in rules if len(sign) == 1]
        for value in outside:
            with pytest.raises(ConfigError) as caught:
                load_config(sets=[f"{setting.key}={value}"])
            assert f"`{setting.key}` = " in caught.value.message
            assert setting.bounds in caught.value.message


def test_numbers_that_multiply_to_more_memory_than_any_machine_has_are_refused() -> None:
    sets = ["train.sampling.rays=1000000", "train.sampling.samples=4096", "train.field.sdf_width=4096"]
    with pytest.raises(ConfigError, match=r"GiB of memory, and 1,024 are the most; lower `train\.sampling\.rays`"):
        load_config(sets=sets)
    for preset in preset_names():
        assert load_config(preset).train.least_bytes() < 8e9


# ---------------------------------------------------------------- groups in groups, and names of before
def test_settings_in_groups_are_set_named_and_refused_like_others():
    sets = ["train.terms.planar.form=stable", "train.terms.planar.rays=9", "train.sampling.rays=8"]
    train = load_config(sets=sets).train
    assert (train.terms.planar.form, train.terms.planar.rays, train.sampling.rays) == ("stable", 9, 8)
    assert train.terms.planar.radius == Config().train.terms.planar.radius
    for text, said in {
        "train.terms.planar.rays=0": "`train.terms.planar.rays` = 0 in --set train.terms.planar.rays=0 is out",
        "train.terms.planar.form=no": "it must be off | paper | stable",
        "train.terms.planar.from=1": "Unknown setting `train.terms.planar.from`",
        "train.terms=3": "for example `train.terms.ambiguity.form`",
        "train.terms.planer.form=off": "Did you mean `train.terms.planar`?",
        "train.ray=3": "Did you mean `train.sampling.rays`?",
        "train.term=3": "Did you mean `train.terms`?",
    }.items():
        with pytest.raises(ConfigError) as caught:
            load_config(sets=[text])
        assert said in f"{caught.value.message} {caught.value.hint}"


def test_every_new_name_exists_and_no_old_one_does():
    known = {setting.key for setting in describe_settings()}
    assert set(RENAMED.values()) <= known
    assert not {*RENAMED, *REMOVED} & known
    assert len(set(RENAMED.values())) == len(RENAMED)


def test_old_names_are_read_with_one_note(tmp_path, caplog):
    assert load_config(sets=["train.holdout=8"]).train.hold_out == 8
    assert [record.getMessage() for record in caplog.records] == [
        "--set train.holdout=8: `train.holdout` is now `train.hold_out`. "
        "Old names are read by this version and not by the next."
    ]
    caplog.clear()
    file = tmp_path / "config.yaml"
    file.write_text("train:\n  rays: 7\n  density: neus\n  planar: paper\n  planar_rays: 3\n  seed: 5\n")
    train = load_config(file=file).train
    assert (train.sampling.rays, train.density.form, train.terms.planar.form) == (7, "neus", "paper")
    assert (train.terms.planar.rays, train.seed) == (3, 5)
    assert len(caplog.records) == 1
    assert "and 1 more" in caplog.text
    caplog.clear()
    load_config("gpu", sets=["train.density.form=neus"])
    assert not caplog.records


def test_a_new_name_wins_over_the_old_one_beside_it(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("train:\n  sampling: {rays: 5}\n  rays: 7\n  samples: 3\n")
    sampling = load_config(file=file).train.sampling
    assert (sampling.rays, sampling.samples) == (5, 3)


def test_an_old_value_that_is_out_of_bounds_is_refused_by_the_new_name():
    with pytest.raises(ConfigError, match=r"`train\.sampling\.rays` = 0 in --set train\.rays=0"):
        load_config(sets=["train.rays=0"])


def test_settings_that_are_gone_are_dropped_where_they_did_nothing(caplog):
    sets = [
        "train.weight_consistency=0.0",
        "train.consistency_rays=99",
        "train.eikonal_start=1",
        "train.eikonal_end=1.0",
    ]
    assert load_config(sets=sets) == Config()
    assert len(caplog.records) == len(sets)
    assert "`train.eikonal_start` is gone" in caplog.text


@pytest.mark.parametrize("text", ["train.weight_consistency=0.1", "train.eikonal_start=0.3", "train.eikonal_end=3"])
def test_settings_that_are_gone_are_refused_where_they_did_something(text):
    with pytest.raises(ConfigError, match="is gone, since") as caught:
        load_config(sets=[text])
    assert "Leave it out" in caught.value.hint


def test_a_stage_s_old_settings_compare_equal_to_the_same_ones_of_today():
    """What a finished stage was made with is no reason to make it again where only names have changed."""
    old = yaml.safe_load((Path(__file__).parent / "config_before_groups.yaml").read_text())
    added = {
        "undistort": {"subject", "masks"},
        "extract": {"fit", "denoising"},
        "train": {
            "steps_if_covered", "losses.dense", "losses.dense_tolerance", "losses.dense_step", "losses.dense_batch",
            "sampling.samples_end", "sampling.needed_share", "schedule.deferred_from", "field.colors", "losses.gloss",
            "terms.planar.start", "evidence", "density.outlines_from", "density.outlines_until",
        },
    }  # fmt: skip
    other_defaults = {"terms.planar.form", "terms.planar.weight"}
    for section in ("train", "undistort", "extract"):
        now = getattr(load_config("demo"), section).model_dump(mode="json")
        then = flatten(section_with_new_names(section, old[section]))
        assert flatten(now).keys() - then.keys() == added.get(section, set())
        kept = then.keys() - other_defaults
        assert {key: then[key] for key in kept} == {key: flatten(now)[key] for key in kept}
        assert section_with_new_names(section, now) == now
    compared = section_with_new_names("train", {**old["train"], "weight_consistency": 0.1, "rays": 7})
    assert (compared["weight_consistency"], compared["sampling"]["rays"]) == (0.1, 7)


def test_an_old_workspace_s_settings_are_read():
    """All the settings of a run of before, as its config.yaml has them."""
    old = load_config(file=Path(__file__).parent / "config_before_groups.yaml")
    assert old.train == load_config("demo", sets=["train.terms.planar.form=off", "train.terms.planar.weight=1"]).train
    assert load_config("demo", sets=settings_beyond("demo", old)) == old


@pytest.mark.parametrize("text", ["auto", "sphere 1 -2.5 3e1 0.5", "box -1 -1 0 1 1 2"])
def test_regions(text: str) -> None:
    assert load_config(sets=[f"place.region={text}"]).place.region == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("place.region=ball 1 2 3 4", "it must be auto, 'sphere X Y Z RADIUS' or 'box X0 Y0 Z0 X1 Y1 Z1'"),
        ("place.region=sphere 1 2 3", "'sphere' takes 4 numbers, got 3"),
        ("place.region=sphere 1 2 3 -1", "the sphere's radius must be at least 1e-06, not -1"),
        ("place.region=box 0 0 0 1 1 0", "each of the box's X1 Y1 Z1 must be larger"),
        ("place.region=box 0 0 0 1 1 wide", "'box' takes 6 numbers, got '0 0 0 1 1 wide'"),
        ("place.region=sphere 0 0 0 .inf", "'sphere' takes 4 numbers, got"),
        ("place.known_distance=0 0 0 1 0 0", "takes 7 numbers, got 6"),
        ("place.known_distance=0 0 0 0 0 0 2", "the two points must not be the same"),
        ("place.known_distance=0 0 0 1 0 0 0", "the distance must be at least 1e-06 metres, not 0"),
    ],
)
def test_wrong_regions_and_distances_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=[text])
    assert message in caught.value.message
    assert text.partition("=")[0] in caught.value.message
