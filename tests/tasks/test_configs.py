"""The settings of all tasks: what their declarations promise, the presets, files."""

import json
import math
import pickle
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest

import etsplat
from etsplat.core.errors import InputError
from etsplat.io.run_directory import FORMAT
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.reconstruct_config import Preset as ReconstructPreset
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import Setting, Settings, docs_of, flatten, get, settings_of
from etsplat.tasks.train_config import SCENE_TYPES, TrainConfig
from etsplat.tasks.train_config import Preset as TrainPreset
from helpers import presets_before as before

CONFIGS: tuple[type[Settings], ...] = (ReconstructConfig, TrainConfig, RenderConfig, ExportConfig)
SETTINGS = [(kind, name, setting) for kind in CONFIGS for name, setting in settings_of(kind).items()]
NAMES = [f"{kind.__name__}.{name}" for kind, name, _ in SETTINGS]
PRESETS = [
    *(ReconstructConfig.of(preset) for preset in get_args(ReconstructPreset)),
    *(TrainConfig.of(preset, scene) for preset in get_args(TrainPreset) for scene in SCENE_TYPES),
]
RECONSTRUCT, TRAIN = ReconstructConfig(), TrainConfig()


@pytest.mark.parametrize(("kind", "name", "setting"), SETTINGS, ids=NAMES)
def test_every_setting_has_help_and_limits(kind: type[Settings], name: str, setting: Setting) -> None:
    """A docstring, whether it is in a group or not; a number has a range, a word its choices."""
    group, _, last = name.rpartition(".")
    owner = type(get(kind(), group)) if group else kind
    assert docs_of(owner)[last]
    assert setting.kind not in (int, float) or setting.choices or setting.range
    assert setting.kind is not str or setting.choices


@pytest.mark.parametrize(("kind", "name", "setting"), SETTINGS, ids=NAMES)
def test_values_are_taken_within_the_limits_and_refused_beyond(
    kind: type[Settings], name: str, setting: Setting
) -> None:
    """At the bounds and one step outside, of another type, NaN and infinity; the error begins with the dotted name."""
    for value in inside(setting):
        assert setting.problem(value) is None, value
    for value in outside(setting):
        with pytest.raises(InputError) as error:
            kind().changed({name: value})
        assert str(error.value).startswith(f"{name}: is ")
        assert "\n" not in str(error.value)


def inside(setting: Setting) -> list[Any]:
    values: list[Any] = [*setting.choices, setting.default]
    if setting.range:
        values += [bound for bound in (setting.range.low, setting.range.high) if math.isfinite(bound)]
    return [int(value) if setting.kind is int and value is not None else value for value in values]


def outside(setting: Setting) -> list[Any]:
    values: list[Any] = [object()]
    if not setting.optional:
        values.append(None)
    if setting.choices:
        return [*values, "nonsense"]
    if setting.kind in (int, float):
        values += ["many", True, math.nan, math.inf, -math.inf]
    if setting.kind in (int, bool):
        values.append(0.5)
    if setting.range:
        low, high, step = setting.range.low, setting.range.high, 1 if setting.kind is int else 1e-9
        values += [int(low) - 1 if setting.kind is int else low - step]
        values += [high + step] if math.isfinite(high) else [10**10, 10**400] if setting.kind is int else [1e31]
    return values


@pytest.mark.parametrize("preset", before.RECONSTRUCT_CHANGES)
def test_presets_of_reconstruct_are_what_they_were(preset: str) -> None:
    """Every setting of then has a name now; what has come since has no effect unless it is asked for or needed."""
    config = flatten(ReconstructConfig.of(preset).to_dict())
    since = {"start.hull_faces": 12_500, "start.near": 0.3, "start.near_edge": 0.02, "start.near_reach": 2.0}
    since["start.near_fall"] = "exponential" if preset in ("paper", "study", "tiny") else "late"
    since["start.near_iterations"] = 1400 if preset == "quick" else 8000 if preset in ("best", "demo") else None
    since["start.near_rate"] = 1 / 3 if preset == "quick" else 0.7
    since["start.near_pace"] = 1 / 3 if preset == "quick" else 1.0
    since["drawing.opaque_from"] = 1.0 if preset in ("paper", "study", "tiny") else 0.9
    since["optimizer.lr_opaque"] = 6e-5 if preset in ("best", "paper") else 3e-4
    since["refinement.reach"] = 0.5
    since["drawing.harmonics"] = 0 if preset in ("paper", "study", "tiny") else None
    since["optimizer.lr_harmonics"] = 5e-4 if preset in ("best", "paper") else 2e-3
    since["start.shape"] = "sphere" if preset in ("paper", "study", "tiny") else "auto"
    since |= {"texture": None, "output.texture_faces": 10_000, "refine_cameras": "off"}
    since["watch"] = 0 if preset in ("paper", "study", "tiny") else None
    since["exposure"] = "off" if preset in ("paper", "study", "tiny") else "auto"
    since["regularization.depth"] = "off" if preset in ("paper", "study", "tiny") else "auto"
    since["regularization.lambda_depth"] = 0.5
    since["refinement.guard"] = 0.0 if preset in ("paper", "study", "tiny") else 0.02
    since["refinement.outlines"] = preset not in ("paper", "study", "tiny")
    since["refinement.flips"] = preset not in ("paper", "study", "tiny")
    since["pixels_per_face"] = None if preset in ("paper", "study", "tiny") else 3.5
    expected = {**before.RECONSTRUCT_PAPER, **before.RECONSTRUCT_CHANGES[preset]}
    named = {before.RECONSTRUCT_NAMES[name]: expected[name] for name in expected}
    if preset == "demo":
        named |= {"iterations": 1500, "refinement.subdivisions": 5, "refinement.untanglings": 3}
    assert config == {"preset": preset, **since, **named}


@pytest.mark.parametrize(("preset", "scene"), before.TRAIN_CHANGES)
def test_presets_of_train_are_what_they_were(preset: str, scene: str) -> None:
    """The same for every kind of scene."""
    config = flatten(TrainConfig.of(preset, scene).to_dict())
    base = before.TRAIN_PAPER if preset == "paper" else before.TRAIN_QUICK
    expected = {**base, **before.TRAIN_CHANGES[preset, scene]}
    named = {before.TRAIN_NAMES[name]: expected[name] for name in expected}
    off = preset == "paper"
    since = {"batch": 1, "watch": 0 if off else None, "exposure": "off" if off else "auto"}
    since |= {"optimizer.lr_vertices_unit": "frame" if off else "view", "pixels_per_triangle": None if off else 45.0}
    since |= {"loss.depth": "off" if off else "auto", "loss.lambda_depth": 0.02, "loss.depth_from": 6000}
    since["loss.lambda_harmonics"] = 0.0 if off else 2.0
    since["schedule.doubtful_epochs"] = None if off else 20
    since["optimizer.lr_vertices_by_size"] = 0.0 if off else 1.0
    since["drawing.dropout"] = 0.0 if preset in ("paper", "tiny") else 4.5
    since["asset"] = preset not in ("paper", "tiny")
    since["start.dense"] = preset not in ("paper", "tiny")
    since["start.nearest"] = 0.0 if preset in ("paper", "tiny") else 0.75
    since["refine_cameras"] = "off"
    if not off:  # 0.0015, and 0.0004 of objects, in the unit of the frame
        since["optimizer.lr_vertices"] = 0.0006
    assert config == {"preset": preset, "scene_type": scene, **named, **since}


def test_defaults_are_those_of_the_command_line() -> None:
    """Preset best, and quick for outdoor scenes; each constructor is its preset."""
    assert ReconstructConfig.best() == RECONSTRUCT
    assert TrainConfig.quick() == TRAIN
    for preset in get_args(ReconstructPreset):
        assert getattr(ReconstructConfig, preset)() == ReconstructConfig.of(preset)
    for preset in get_args(TrainPreset):
        assert getattr(TrainConfig, preset)(scene="indoor") == TrainConfig.of(preset, "indoor")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ReconstructConfig(preset="quick"), r"preset: 'quick' .* begin with ReconstructConfig\.quick\(\)$"),
        (lambda: ReconstructConfig(preset="demo", iterations=7), r"begin with ReconstructConfig\.demo\(\)$"),
        (lambda: RECONSTRUCT.changed({"preset": "tiny"}), r"begin with ReconstructConfig\.tiny\(\)$"),
        (lambda: TrainConfig(preset="tiny", scene_type="indoor"), r"begin with TrainConfig\.tiny\('indoor'\)$"),
        (lambda: TrainConfig.paper("object").changed({"preset": "demo"}), r"TrainConfig\.demo\('object'\)$"),
        (lambda: TrainConfig(preset="huge"), r"preset: is 'huge'; choose one of paper, quick"),  # pyright: ignore
    ],
)
def test_a_preset_is_no_mere_label(make: Callable[[], Settings], message: str) -> None:
    """Naming one beside the settings of another is refused, with what to begin with; its own name does no harm."""
    with pytest.raises(InputError, match=message):
        make()
    assert ReconstructConfig(preset="best", iterations=7) == RECONSTRUCT.changed({"iterations": 7, "preset": "best"})
    assert replace(TrainConfig.tiny("indoor"), seed=1) == TrainConfig.tiny("indoor").changed({"seed": 1})
    assert pickle.loads(pickle.dumps(TrainConfig.paper())) == TrainConfig.paper() == deepcopy(TrainConfig.paper())


@pytest.mark.parametrize("config", PRESETS, ids=lambda config: f"{config.TASK} {config.preset}")
def test_settings_come_back_from_a_file(config: Settings, tmp_path: Path) -> None:
    """The same config, whether the file is a run's config.json or holds the settings alone; hashes do not change."""
    record = {"format": FORMAT, "task": config.TASK, "config": config.to_dict()}
    for name, content in (("config.json", record), ("settings.json", config.to_dict())):
        (tmp_path / name).write_text(json.dumps(content))
        again = type(config).from_file(tmp_path / name)
        assert again == config
        assert json.dumps(again.to_dict()) == json.dumps(config.to_dict())


def test_a_part_of_the_settings_is_enough(tmp_path: Path) -> None:
    """The rest is that of the preset that the file names, else of the default; dotted names and groups both work."""
    path = tmp_path / "mine.json"
    path.write_text('{"preset": "paper", "scene_type": "indoor", "optimizer.lr_sigma": 1, "loss": {"lambda_size": 0}}')
    changes = {"optimizer.lr_sigma": 1.0, "loss.lambda_size": 0.0}
    assert TrainConfig.from_file(path) == TrainConfig.paper("indoor").changed(changes)
    path.write_text('{"output": {"lpips_weights": "weights.pth"}}')
    weights = {"output.lpips_weights": Path("weights.pth")}
    assert ReconstructConfig.from_file(path) == RECONSTRUCT.changed(weights)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"optimizer": {"lr_vertice": 1}}', r"optimizer\.lr_vertice: is no setting; did you mean optimizer\.lr_vert"),
        ('{"lr_colors": 1}', r"lr_colors: is no setting; did you mean optimizer\.lr_colors\?"),
        ('{"banana": 1}', r"banana: is no setting$"),
        ('{"optimizer": 1}', r"optimizer: is a group of settings"),
        ('{"iterations": "many"}', r"iterations: is 'many'; it must be a whole number"),
        ('{"optimizer": {"lr_vertices": -1}}', r"optimizer\.lr_vertices: is -1\.0; it must be at least 0"),
        ('{"start": {"opacity": 2}}', r"start\.opacity: is 2\.0; it must be between 0\.01 and 0\.999"),
        ('{"regularization": {"edge_power": 3}}', r"edge_power: is 3; choose one of 1, 2"),
        ('{"preset": "huge"}', r"preset: is 'huge'; choose one of best, paper"),
        ('{"preset": ["quick"]}', r"preset: is \['quick'\]; choose one of best, paper"),
        ('{"preset": {}, "iterations": 3}', r"preset: is \{\}; choose one of"),
        ('{"method": ["elastic"]}', r"method: is \['elastic'\]; choose one of"),
        ('{"seed": [1]}', r"seed: is \[1\]; it must be a whole number"),
        ('{"refinement": {"first": 0.7}}', r"refinement\.first: is after refinement\.last; make it smaller"),
        ('{"iterations": ', r"is not JSON"),
        ("[" * 100_000, r"is not JSON \(nested too deep\)"),
        ('{"iterations": ' + "9" * 400 + "}", r"iterations: is 9+; it must be at most 1e\+09"),
        ('{"iterations": ' + "9" * 5000 + "}", r"is not JSON"),
        ('{"optimizer": {"lr_vertices": 1e308}}', r"lr_vertices: is 1e\+308; it must be at most 1e\+30"),
        ('{"optimizer": {"lr_vertices": NaN}}', r"lr_vertices: is nan; it must be at least 0"),
        ("[1, 2]", r"holds no settings"),
        (json.dumps({"format": FORMAT}), r"has the settings of `etsplat None`"),
        (json.dumps({"format": FORMAT, "task": "reconstruct"}), r"holds no settings"),
        ('{"optimizer": {"lr_vertices": ' + "9" * 400 + "}}", r"lr_vertices: is 9+; it must be at most 1e\+30"),
        (json.dumps({"format": FORMAT, "task": "train", "config": {}}), r"has the settings of `etsplat train`"),
    ],
)
def test_files_that_cannot_be_used_are_named_with_what_is_wrong(tmp_path: Path, content: str, message: str) -> None:
    """One line: the file, the setting, and what was probably meant."""
    path = tmp_path / "mine.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        ReconstructConfig.from_file(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_labels_that_no_table_can_be_asked_for_are_refused() -> None:
    """From Python as from a file."""
    for wrong in ({"preset": []}, {"scene_type": ["indoor"]}):
        for make in (TRAIN.changed, TrainConfig.based_on, lambda changes: replace(TRAIN, **changes)):
            with pytest.raises(InputError, match=f"{next(iter(wrong))}: is \\["):
                make(wrong)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json: cannot be read"):
        TrainConfig.from_file(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("config", "changes", "allowed"),
    [
        (RECONSTRUCT, {"method": "raster-face", "start.sigma": 0.3}, {"method": "elastic"}),
        (RECONSTRUCT, {"method": "raster-vertex", "drawing.colors": "vertex"}, {"method": "bilateral"}),
        (RECONSTRUCT, {"method": "raster-face", "drawing.distance": "sdf"}, {"method": "elastic"}),
        (RECONSTRUCT, {"drawing.backend": "nvdiffrast"}, {"method": "raster-face"}),
        (RECONSTRUCT, {"optimizer.large_steps_weight": 3.0}, {"optimizer.vertex_update": "large-steps"}),
        (
            RECONSTRUCT,
            {"optimizer.sigma_final": 0.1, "optimizer.lr_sigma": 0.1},
            {"optimizer.sigma_final": 0.0},
        ),
        (
            RECONSTRUCT,
            {"pictures.coarse_levels": 0, "pictures.coarse_until": 0.2},
            {"pictures.coarse_levels": 1},
        ),
        (TRAIN, {"drawing.freeze_inradius": False}, {"method": "single-sided"}),
        (TRAIN, {"loss.regularize_from": 100}, {"loss.lambda_distortion": 1.0}),
        (TRAIN, {"finish": "opaque", "loss.lambda_opacity": 0.1}, {"finish": "none"}),
        (TRAIN, {"finish": "opaque", "densification.replace_dead": False}, {"finish": "none"}),
        (TRAIN, {"drawing.sh_degree": 0, "schedule.sh_every": 10}, {"drawing.sh_degree": 1}),
        (RenderConfig(), {"frames": 7}, {"path": "orbit"}),
        (RenderConfig(), {"fps": 7}, {"format": "mp4"}),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else type(value).__name__,
)
def test_what_would_have_no_effect_is_refused(
    config: Settings, changes: dict[str, Any], allowed: dict[str, Any]
) -> None:
    """With the name of the setting and what it needs; where it has that, it is taken."""
    with pytest.raises(InputError, match="|".join(name.replace(".", r"\.") for name in changes)):
        config.changed(changes)
    config.changed({**changes, **allowed})


def test_a_method_without_softness_takes_the_soft_settings_of_its_preset() -> None:
    """What a preset says of softness is nobody's wish, so every method goes with every preset."""
    for preset in get_args(ReconstructPreset):
        assert replace(ReconstructConfig.of(preset), method="raster-face").start == ReconstructConfig.of(preset).start
    for preset in get_args(TrainPreset):
        for scene in SCENE_TYPES:
            assert replace(TrainConfig.of(preset, scene), finish="opaque").finish == "opaque"


def test_methods_may_be_written_as_kernels() -> None:
    """single_sided is single-sided."""
    assert replace(TRAIN, method="single_sided") == replace(TRAIN, method="single-sided")
    assert RECONSTRUCT.changed({"method": "raster_face"}).method == "raster-face"
    with pytest.raises(InputError, match="method: is 'double-sided'; choose one of elastic, bilateral, single-sided"):
        replace(TRAIN, method="double-sided")


def test_changes_are_written_as_a_list() -> None:
    """Numbers, none, true and false have the type of their setting."""
    text = "iterations=2e3,start.limit=none,drawing.cull_small=True,optimizer.lr_sigma=1"
    assert TRAIN.read_changes(text) == {
        "iterations": 2000,
        "start.limit": None,
        "drawing.cull_small": True,
        "optimizer.lr_sigma": 1.0,
    }
    for wrong, message in (("iterations=2.5", "whole number"), ("normalize=maybe", "true or false"), ("seed", "NAME=")):
        with pytest.raises(InputError, match=message):
            TRAIN.changed(TRAIN.read_changes(wrong))


@pytest.mark.parametrize(("task", "kind"), [(etsplat.train, "TrainConfig"), (etsplat.reconstruct, "ReconstructConfig")])
def test_settings_of_another_kind_are_refused(task: Callable[..., object], kind: str, tmp_path: Path) -> None:
    for wrong in ("quick", {"iterations": 5}):
        got = type(wrong).__name__
        with pytest.raises(ValueError, match=rf"config must be a {kind}, got {got}: etsplat\.{kind}\.of\(PRESET\)"):
            task("demo:scene", tmp_path, wrong)
