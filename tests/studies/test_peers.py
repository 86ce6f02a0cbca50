"""3DGS and 2DGS through a module that stands in for gsplat: the same grid, split, metrics and tables as our runs.

Where gsplat is installed, its signatures and its densification are the real ones; its drawing needs a GPU.
"""

import inspect
import sys
from types import SimpleNamespace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.core.harmonics import SH_CONSTANT
from etsplat.io.run_directory import RunDirectory
from etsplat.model.soup_init import StartPoints
from helpers import fake_gsplat
from helpers.captures import write_colmap
from studies import gsplat_on_cpu
from studies.peers import training
from studies.peers.gaussians import NAMES, load_gaussians, start_gaussians
from studies.peers.settings import load_gsplat, peer_config
from studies.peers.training import train_peer
from studies.scenes import cells as scene_cells
from studies.scenes.cells import evaluate_cells, make_nvs_cells, read_scene_argument
from studies.scenes.pictures import draw_nvs
from studies.scenes.tables import nvs_tables


def put_in_place(module, monkeypatch):
    def load():
        return module, torch.device("cpu")

    monkeypatch.setattr(training, "load_gsplat", load)
    monkeypatch.setattr(scene_cells, "load_gsplat", load)


@pytest.fixture
def gsplat(monkeypatch):
    put_in_place(fake_gsplat, monkeypatch)
    fake_gsplat.DefaultStrategy.made.clear()
    return fake_gsplat


@pytest.fixture
def real_gsplat(monkeypatch):
    """gsplat itself, but for its two functions that draw: arguments must fit theirs, the stand-in draws."""
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed (group studies)")

    def drawing(name):
        signature = inspect.signature(getattr(gsplat, name))

        def draw(**arguments):
            signature.bind(**arguments)
            return getattr(fake_gsplat, name)(**arguments)

        return draw

    draw_3dgs, draw_2dgs = drawing("rasterization"), drawing("rasterization_2dgs")
    module = SimpleNamespace(
        __version__=gsplat.__version__,
        rasterization=draw_3dgs,
        rasterization_2dgs=draw_2dgs,
        DefaultStrategy=gsplat.DefaultStrategy,
        strategy=gsplat.strategy,
    )
    put_in_place(module, monkeypatch)
    return module


def rotations(quats):
    """(N, 3, 3) of (N, 4) quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=1)
    second = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=2)


def cells_of(folder, methods):
    return make_nvs_cells(
        [read_scene_argument(str(folder / "toy"))],
        methods,
        folder / "out",
        preset="tiny",
        culling=(False, True),
        setting="iterations=30,width=24",
    )


@pytest.mark.parametrize("method", ["3dgs", "2dgs"])
def test_a_peer_is_trained_measured_and_tabulated_as_our_methods_are(tmp_path, gsplat, method):
    write_colmap(tmp_path / "toy", [(48, 36)] * 9)
    (cell,) = cells_of(tmp_path, [method])
    assert (cell.variant, cell.config.iterations, cell.config.width) == (method, 30, 24)
    train_peer(cell.source, cell.folder, cell.config)
    again = cells_of(tmp_path, [method])[0]
    assert again.state == "done"
    strategy = fake_gsplat.DefaultStrategy.made[-1]
    assert strategy.schedule == (1, 15, 100, 3000)  # 500 and 15,000 of 30,000 iterations; intervals stay
    assert (strategy.prune_opa, strategy.key) == {"3dgs": (0.005, "means2d"), "2dgs": (0.05, "gradient_2dgs")}[method]
    assert strategy.steps == list(range(30))
    history = RunDirectory(cell.folder).read_history()
    assert (history[-1]["iteration"], history[-1]["triangles"]) == (30, 40)
    gaussians = load_gaussians(cell.folder / training.FILE, torch.device("cpu"))
    assert gaussians["shN"].shape == (40, 15, 3)
    assert [len(gaussians[name]) for name in NAMES] == [40] * 6
    (row,) = evaluate_cells([again], None, lambda done, total: None)
    assert row["psnr"] == pytest.approx(again.metrics()["psnr"], abs=1e-3)
    assert (row["width"], row["height"], row["triangles"], row["psnr_opaque"]) == (24, 18, 40, None)
    tables = {table.name: table for table in nvs_tables([row])}
    assert tables["efficiency"].rows[0][0] == method
    draw_nvs([again], [method], tmp_path / "nvs.png")
    draw_nvs([again], [method], tmp_path / "trisoup.png", kind="opaque")


def test_training_a_peer_brings_the_loss_down(tmp_path, gsplat):
    write_colmap(tmp_path / "toy", [(24, 18)] * 9, points=60)
    train_peer(
        tmp_path / "toy", tmp_path / "run", peer_config("3dgs", iterations=100, schedule_length=100, lr_sh_dc=0.05)
    )
    losses = [line["loss"] for line in RunDirectory(tmp_path / "run").read_history()]
    assert losses[-1] < 0.95 * losses[0]


@pytest.mark.parametrize("method", ["3dgs", "2dgs"])
def test_a_peer_that_was_interrupted_goes_on_from_its_checkpoint(tmp_path, gsplat, monkeypatch, method):
    """Gaussians, moments, statistics of the strategy and order of views come to what they are without interruption: the
    random numbers that gsplat draws before the checkpoint are those of the seed."""
    write_colmap(tmp_path / "toy", [(24, 18)] * 5)
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 10)
    config = peer_config(method, iterations=30, schedule_length=30, densify_from=5)
    train_peer(tmp_path / "toy", tmp_path / "whole", config)
    whole = fake_gsplat.DefaultStrategy.made[-1]
    torch.rand(1)  # what else the process draws makes no difference
    step = training._Fitting._step

    def interrupted(self, iteration):
        if iteration == 26:
            raise KeyboardInterrupt
        return step(self, iteration)

    monkeypatch.setattr(training._Fitting, "_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train_peer(tmp_path / "toy", tmp_path / "parts", config)
    monkeypatch.setattr(training._Fitting, "_step", step)
    train_peer(tmp_path / "toy", tmp_path / "parts", config, resume=True)
    rest = fake_gsplat.DefaultStrategy.made[-1]
    assert rest.steps == list(range(20, 30))
    assert torch.equal(rest.pulls, whole.pulls)
    expected = load_gaussians(tmp_path / "whole" / training.FILE, torch.device("cpu"))
    gaussians = load_gaussians(tmp_path / "parts" / training.FILE, torch.device("cpu"))
    assert all(torch.equal(gaussians[name], expected[name]) for name in NAMES)
    losses = [[line["loss"] for line in RunDirectory(tmp_path / name).read_history()] for name in ("whole", "parts")]
    assert losses[0] == losses[1]


@pytest.mark.parametrize(("kind", "modes"), [("outdoor", {"RGB", "RGB+ED"}), ("object", {"RGB"})])
def test_2dgs_fits_normals_except_on_objects(tmp_path, gsplat, monkeypatch, kind, modes):
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    seen = set()
    draw = fake_gsplat.rasterization_2dgs
    monkeypatch.setattr(
        fake_gsplat, "rasterization_2dgs", lambda **kwargs: seen.add(kwargs["render_mode"]) or draw(**kwargs)
    )
    scene = read_scene_argument(f"{tmp_path / 'toy'}:{kind}")
    setting = "iterations=30,width=24"
    (cell,) = make_nvs_cells([scene], ["2dgs"], tmp_path / "out", preset="tiny", culling=(False,), setting=setting)
    train_peer(cell.source, cell.folder, cell.config)
    assert seen == modes


@pytest.mark.parametrize(("method", "opacity"), [("3dgs", 0.01), ("2dgs", 0.1)])
def test_opacities_are_reset_which_gsplat_1_5_3_does_not_do(tmp_path, gsplat, monkeypatch, method, opacity):
    """At steps 10, 20 and 30, counted from 0, and not at 40, where densification ends."""
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    resets = []
    reset = fake_gsplat.strategy.ops.reset_opa
    monkeypatch.setattr(
        fake_gsplat.strategy.ops,
        "reset_opa",
        lambda *arguments: resets.append(len(fake_gsplat.DefaultStrategy.made[-1].steps) - 1) or reset(*arguments),
    )
    schedule = {"iterations": 50, "schedule_length": 50, "reset_every": 10, "densify_until": 40}
    config = peer_config(method, **schedule, start_opacity=0.6, lr_opacities=0.0)
    train_peer(tmp_path / "toy", tmp_path / "run", config)
    assert resets == [10, 20, 30]
    gaussians = load_gaussians(tmp_path / "run" / training.FILE, torch.device("cpu"))
    assert gaussians["opacities"].sigmoid().tolist() == pytest.approx([opacity] * len(gaussians["means"]), rel=1e-4)


def test_a_2d_gaussian_starts_without_thickness():
    """gsplat draws it so, but measures and splits it by all its scales."""
    points = StartPoints(torch.rand(20, 3), torch.rand(20, 3))
    solid, flat = (
        start_gaussians(points, peer_config(method), torch.Generator())["scales"].detach().exp()
        for method in ("3dgs", "2dgs")
    )
    assert torch.equal(solid[:, 2], solid[:, 0])
    assert torch.equal(flat[:, :2], solid[:, :2])
    assert (flat[:, 2] > 0).all()
    assert (flat[:, 2] < 1e-6 * flat[:, 0]).all()


@pytest.mark.parametrize("method", ["3dgs", "2dgs"])
def test_gsplats_own_strategy_densifies_prunes_and_resets_our_gaussians(tmp_path, real_gsplat, monkeypatch, method):
    """All calls fit its signatures; a run that is interrupted between two densifications goes on with it."""
    write_colmap(tmp_path / "toy", [(24, 18)] * 5)
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 10)
    schedule = {"densify_from": 5, "densify_until": 40, "densify_every": 8, "reset_every": 25}
    config = peer_config(method, iterations=60, schedule_length=60, normals_from=30, **schedule)
    step = training._Fitting._step
    counts, opaque = {}, {}

    def watched(self, iteration, last=60):
        if iteration > last:
            raise KeyboardInterrupt
        loss = step(self, iteration)
        counts[iteration - 1] = self.count
        opaque[iteration - 1] = float(self.gaussians["opacities"].detach().sigmoid().max())
        return loss

    monkeypatch.setattr(training._Fitting, "_step", lambda self, iteration: watched(self, iteration, last=37))
    with pytest.raises(KeyboardInterrupt):
        train_peer(tmp_path / "toy", tmp_path / "run", config)
    monkeypatch.setattr(training._Fitting, "_step", watched)
    metrics = train_peer(tmp_path / "toy", tmp_path / "run", config, resume=True)
    assert counts[7] == counts[0] < counts[8]  # refined at 8, 16, 24, 32
    assert counts[32] != counts[31]
    assert counts[39] == counts[59] == metrics["triangles"]
    limit = 2 * config.prune_opacity
    assert opaque[25] == pytest.approx(limit, rel=1e-3)
    assert opaque[24] > 1.01 * limit
    assert opaque[59] > 1.01 * limit
    assert metrics["versions"]["gsplat"] == real_gsplat.__version__


@pytest.mark.parametrize("method", ["3dgs", "2dgs"])
def test_gsplat_on_the_cpu_draws_one_gaussian_after_the_other(monkeypatch, method):
    """studies/gsplat_on_cpu.py against a loop over Gaussians; of a disk, by where each pixel's ray meets it."""
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed (group studies)")
    if gsplat.__version__ != gsplat_on_cpu.VERSION:
        pytest.skip(f"needs gsplat {gsplat_on_cpu.VERSION}")
    for module, name, value in gsplat_on_cpu.replacements():
        monkeypatch.setattr(module, name, value)
    rng = torch.Generator().manual_seed(0)
    means, quats, scales = (torch.rand(30, size, generator=rng) for size in (3, 4, 3))
    means, scales = means * 2 - 1 + torch.tensor([0, 0, 3.0]), scales * 0.2 + 0.05
    opacities, colors = 0.9 * torch.rand(30, generator=rng), torch.rand(30, 1, 3, generator=rng)
    Ks, background = torch.tensor([[[30.0, 0, 15], [0, 30, 12], [0, 0, 1]]]), torch.tensor([[0.2, 0.5, 0.9]])
    scene = (means, quats, scales, opacities, colors, torch.eye(4)[None], Ks, 30, 24)
    draw = gsplat.rasterization if method == "3dgs" else gsplat.rasterization_2dgs
    drawn, covered, *_, info = draw(*scene, sh_degree=0, packed=False, backgrounds=background)
    y, x = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(30) + 0.5, indexing="ij")
    rays = torch.stack([(x - 15) / 30, (y - 12) / 30, torch.ones_like(x)], dim=-1)
    axes = rotations(quats) * scales[:, None]
    color, left = torch.zeros(24, 30, 3), torch.ones(24, 30, 1)
    for i in info["depths"][0].argsort():
        offset = torch.stack([x, y], dim=-1) - info["means2d"][0, i]
        if method == "3dgs":
            a, b, c = info["conics"][0, i]
            square = a * offset[..., 0] ** 2 + c * offset[..., 1] ** 2 + 2 * b * offset[..., 0] * offset[..., 1]
        else:
            sides = torch.stack([*axes[i].T[:2].expand(24, 30, 2, 3).unbind(dim=2), -rays], dim=-1)
            on_disk = torch.linalg.solve(sides, -means[i].expand(24, 30, 3))[..., :2]
            square = torch.minimum(on_disk.square().sum(dim=-1), 2 * offset.square().sum(dim=-1))
        middle, reach = info["means2d"][0, i], info["radii"][0, i]
        place = torch.stack([x, y], dim=-1) - 0.5
        boxed = ((place >= (middle - reach).floor()) & (place < (middle + reach).ceil())).all(dim=-1)
        alpha = opacities[i] * torch.exp(-square / 2)
        alpha = torch.where(boxed & (alpha >= 1 / 255), alpha, 0.0)[..., None]
        color, left = color + left * alpha * (0.5 + SH_CONSTANT * colors[i, 0]), left * (1 - alpha)
    torch.testing.assert_close(drawn[0], color + left * background[0], atol=2e-6, rtol=0)
    torch.testing.assert_close(covered[0], 1 - left, atol=2e-6, rtol=0)
    assert float(covered.detach().mean()) > 0.1


def test_peers_stand_once_beside_our_methods_with_and_without_culling(tmp_path, gsplat):
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    variants = [cell.variant for cell in cells_of(tmp_path, ["elastic", "2dgs", "3dgs"])]
    assert variants == ["elastic", "elastic culling", "3dgs", "2dgs"]


def test_without_gsplat_or_a_gpu_the_grid_says_so_before_anything_runs(tmp_path, monkeypatch):
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match="pip install --group studies"):
        cells_of(tmp_path, ["elastic", "3dgs"])
    monkeypatch.setitem(sys.modules, "gsplat", fake_gsplat)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="need an NVIDIA GPU"):
        load_gsplat()
    assert not (tmp_path / "out").exists()
