"""3DGS and 2DGS through a module that stands in for gsplat: the same grid, split, metrics and tables as our runs."""

import sys

import pytest
import torch

import fake_gsplat
from captures import write_colmap
from etsplat.bench import nvs, train_peer
from etsplat.bench.gaussians import NAMES, load_gaussians
from etsplat.bench.nvs import evaluate_cells, make_nvs_cells, read_scene_argument
from etsplat.bench.nvs_figures import draw_nvs
from etsplat.bench.nvs_tables import nvs_tables
from etsplat.bench.peers import PeerConfig, load_gsplat
from etsplat.core.errors import InputError
from etsplat.io.run_directory import RunDirectory


@pytest.fixture
def gsplat(monkeypatch):
    def load():
        return fake_gsplat, torch.device("cpu")

    monkeypatch.setattr(train_peer, "load_gsplat", load)
    monkeypatch.setattr(nvs, "load_gsplat", load)
    fake_gsplat.DefaultStrategy.made.clear()
    return fake_gsplat


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
    train_peer.train_peer(cell.mesh, cell.folder, cell.config)
    again = cells_of(tmp_path, [method])[0]
    assert again.state == "done"
    strategy = fake_gsplat.DefaultStrategy.made[-1]
    assert strategy.schedule == (1, 15, 1, 3)  # 500, 15,000, 100 and 3,000 of 30,000 iterations
    assert strategy.steps == list(range(30))
    history = RunDirectory(cell.folder).read_history()
    assert (history[-1]["iteration"], history[-1]["triangles"]) == (30, 40)
    gaussians = load_gaussians(cell.folder / train_peer.FILE, torch.device("cpu"))
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
    train_peer.train_peer(tmp_path / "toy", tmp_path / "run", PeerConfig("3dgs", 100, 100, lr_sh_dc=0.05))
    losses = [line["loss"] for line in RunDirectory(tmp_path / "run").read_history()]
    assert losses[-1] < 0.95 * losses[0]


@pytest.mark.parametrize("method", ["3dgs", "2dgs"])
def test_a_peer_that_was_interrupted_goes_on_from_its_checkpoint(tmp_path, gsplat, monkeypatch, method):
    """Gaussians, moments, statistics of the strategy and order of views come to what they are without interruption."""
    write_colmap(tmp_path / "toy", [(24, 18)] * 5)
    monkeypatch.setattr(train_peer, "CHECKPOINT_EVERY", 10)
    config = PeerConfig(method, 30, 30)
    train_peer.train_peer(tmp_path / "toy", tmp_path / "whole", config)
    whole = fake_gsplat.DefaultStrategy.made[-1]
    step = train_peer._Fitting._step

    def interrupted(self, iteration):
        if iteration == 26:
            raise KeyboardInterrupt
        return step(self, iteration)

    monkeypatch.setattr(train_peer._Fitting, "_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train_peer.train_peer(tmp_path / "toy", tmp_path / "parts", config)
    monkeypatch.setattr(train_peer._Fitting, "_step", step)
    train_peer.train_peer(tmp_path / "toy", tmp_path / "parts", config, resume=True)
    rest = fake_gsplat.DefaultStrategy.made[-1]
    assert rest.steps == list(range(20, 30))
    assert torch.equal(rest.pulls, whole.pulls)
    expected = load_gaussians(tmp_path / "whole" / train_peer.FILE, torch.device("cpu"))
    gaussians = load_gaussians(tmp_path / "parts" / train_peer.FILE, torch.device("cpu"))
    assert all(torch.equal(gaussians[name], expected[name]) for name in NAMES)
    losses = [[line["loss"] for line in RunDirectory(tmp_path / name).read_history()] for name in ("whole", "parts")]
    assert losses[0] == losses[1]


def test_peers_stand_once_beside_our_methods_with_and_without_culling(tmp_path, gsplat):
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    variants = [cell.variant for cell in cells_of(tmp_path, ["elastic", "2dgs", "3dgs"])]
    assert variants == ["elastic", "elastic culling", "3dgs", "2dgs"]


def test_without_gsplat_or_a_gpu_the_grid_says_so_before_anything_runs(tmp_path, monkeypatch):
    write_colmap(tmp_path / "toy", [(24, 18)] * 3)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match=r"pip install 'etsplat\[peers\]'"):
        cells_of(tmp_path, ["elastic", "3dgs"])
    monkeypatch.setitem(sys.modules, "gsplat", fake_gsplat)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="need an NVIDIA GPU"):
        load_gsplat()
    assert not (tmp_path / "out").exists()
