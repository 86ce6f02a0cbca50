"""3DGS and 2DGS with gsplat on the same photos, split, iterations and metrics as our methods.

gsplat draws and its DefaultStrategy densifies, both through its public functions (as of 1.5.3); the start, the order of
views, the loss and all metrics are ours. Needs an NVIDIA GPU.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.load import load_dataset
from etsplat.data.loader import View, ViewLoader
from etsplat.io.images import save_image
from etsplat.io.run_directory import RunDirectory
from etsplat.metrics.image import psnr, ssim
from etsplat.model.soup_init import StartPoints, random_points
from etsplat.ops.photometric import photometric_loss
from etsplat.optim.drive import drive
from etsplat.optim.loop import LoopSettings, Progress, UndoEvent
from etsplat.optim.schedules import exponential_decay, limited_iterations
from etsplat.optim.view_sampler import ViewSampler
from etsplat.tasks.running import (
    Place,
    device_name,
    hash_record,
    make_record,
    path_of,
    versions,
)
from etsplat.tasks.scoring import Scorer, drawing_speed, image_scores, load_lpips, mean_scores
from studies.peers.gaussians import NAMES, Splatting, load_gaussians, save_gaussians, splat, start_gaussians
from studies.peers.settings import PeerConfig, load_gsplat

FILE = "gaussians.safetensors"
LOG_EVERY = 50
CHECKPOINT_EVERY = 1000


def train_peer(
    source: Path, out: Path, config: PeerConfig, images: str | None = None, *, resume: bool = False
) -> dict[str, Any]:
    """Fits Gaussians to the photos of a scene; returns metrics.json.

    Args:
        source: the scene's folder.
        out: the run directory; an earlier run in it is replaced unless it is resumed.
        config: settings.
        images: folder in the scene to take the photos from.
        resume: go on from the last checkpoint. Not to the bit: gsplat adds in any order, and draws random numbers.

    Raises:
        InputError: no gsplat, no GPU, a scene that cannot be used, a full disk; a run with other settings to resume.
        DivergedError: the loss is not finite.
    """
    gsplat, device = load_gsplat()
    own = load_dataset(source, images=images, width=config.width)
    capture = own.normalized()
    iterations = limited_iterations(config.iterations, config.max_epochs, len(own.train))
    paths = {"source": path_of(source), "images": images}
    record = make_record(config, iterations, {"fingerprint": own.fingerprint()}, paths)
    config = replace(config, iterations=iterations)
    place = Place(out, resume, overwrite=not resume)
    fitting = _Fitting(gsplat, capture, config, device)
    with place.open(record, print) as run:
        settings = LoopSettings(config.iterations, LOG_EVERY, evaluate_every=0, checkpoint_every=CHECKPOINT_EVERY)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(config.seed)  # gsplat splits at random
            drive(fitting, progress := Progress(), settings, (), run, hash_record(record))
        save_gaussians(run.path / FILE, fitting.gaussians)
        drawing = PeerDrawing(gsplat, fitting.gaussians, capture, config, device)
        run.write_metrics(
            {
                **drawing.draw_test_views(run.test),
                "triangles": fitting.count,
                "iterations": config.iterations,
                "seconds": progress.seconds,
                "device": device_name(device),
                "method": config.method,
                "seed": config.seed,
                "versions": {**versions(), "gsplat": gsplat.__version__},
            }
        )
    return run.read_metrics()


def evaluate_peer(folder: Path, config: PeerConfig, lpips_weights: Path | None) -> dict[str, Any]:
    """The numbers of `tasks.scoring.evaluate_run` for a finished run of `train_peer`; no opaque ones."""
    gsplat, device = load_gsplat()
    paths = RunDirectory(folder).read_config()["paths"]
    capture = load_dataset(paths["source"], images=paths["images"], width=config.width, preload=False).normalized()
    gaussians = load_gaussians(folder / FILE, device)
    drawing = PeerDrawing(gsplat, gaussians, capture, config, device)
    lpips, reason = load_lpips(lpips_weights, device)
    rows = []
    for view in capture.test:
        picture, photo = drawing.pair(view)
        rows.append({"name": capture.names[view], **image_scores(picture, photo, lpips)})
    cameras = [capture.cameras[view] for view in capture.test]
    speed = drawing_speed(drawing.render, cameras, device, len(gaussians["means"]))
    opaque = {"psnr_opaque": None, "ssim_opaque": None}
    return {**mean_scores(rows), **opaque, "lpips_reason": reason, **speed, "engine": "gsplat", "views": rows}


class PeerDrawing:
    """Pictures of finished Gaussians, and how they compare with the photos of the test views."""

    def __init__(
        self,
        gsplat: Any,
        gaussians: nn.ParameterDict,
        capture: Dataset,
        config: PeerConfig,
        device: torch.device,
        background: Float[Tensor, "1 3"] | None = None,
    ) -> None:
        """Takes what drawing needs; behind everything is the background, or that of the settings for None."""
        self._gsplat, self._gaussians, self._capture, self._config = gsplat, gaussians, capture, config
        self._background = _background(config, device) if background is None else background
        self._scorer = Scorer(capture, device, background=self._background[0].tolist())
        self._device = device

    @torch.no_grad()
    def render(self, cameras: Cameras, *, backgrounds: Tensor | None = None) -> Splatting:
        """As a model of ours draws itself."""
        behind = self._background if backgrounds is None else backgrounds
        return splat(self._gsplat, self._gaussians, cameras, self._config, behind)

    def pair(self, view: int) -> tuple[Tensor, Tensor]:
        """Picture and photo (H, W, 3); pixels that a mask excludes agree."""
        model: Any = self
        seen = self._scorer.see(model, view)
        return seen.counting(seen.splatted), seen.photo

    def draw_test_views(self, folder: Path) -> dict[str, Any]:
        """NNN_render.png and NNN_truth.png of every test view; mean PSNR and SSIM, None without test views."""
        scores: dict[str, list[float]] = {"psnr": [], "ssim": []}
        for number, view in enumerate(self._capture.test):
            picture, photo = self.pair(view)
            scores["psnr"].append(psnr(picture, photo))
            scores["ssim"].append(ssim(picture, photo))
            save_image(folder / f"{number:03d}_render.png", picture)
            save_image(folder / f"{number:03d}_truth.png", photo)
        return {name: sum(values) / len(values) if values else None for name, values in scores.items()}


class _Fitting:
    """Parameters, their optimizers and gsplat's strategy: what `optim.loop` drives."""

    def __init__(self, gsplat: Any, capture: Dataset, config: PeerConfig, device: torch.device) -> None:
        self._gsplat, self._config, self._device = gsplat, config, device
        generator = torch.Generator().manual_seed(config.seed)
        positions, colors = capture.points, capture.point_colors
        if positions is None:
            points = random_points(config.start_points, capture.viewmats[capture.train], generator)
        else:
            points = StartPoints(positions, torch.full_like(positions, 0.5) if colors is None else colors)
        self.gaussians = start_gaussians(points, config, generator).to(device)
        rates = {
            "means": config.lr_means,
            "scales": config.lr_scales,
            "quats": config.lr_quats,
            "opacities": config.lr_opacities,
            "sh0": config.lr_sh_dc,
            "shN": config.lr_sh_rest,
        }
        self._optimizers = {
            name: torch.optim.Adam([self.gaussians[name]], lr=rate, eps=1e-15) for name, rate in rates.items()
        }
        self._strategy = gsplat.DefaultStrategy(
            refine_start_iter=config.at(config.densify_from),
            refine_stop_iter=config.at(config.densify_until),
            refine_every=config.densify_every,
            reset_every=config.reset_every,
            prune_opa=config.prune_opacity,
            key_for_gradient="means2d" if config.method == "3dgs" else "gradient_2dgs",
        )
        self._strategy.check_sanity(self.gaussians, self._optimizers)
        self._state = self._strategy.initialize_state(scene_scale=1.0)  # the frame is normalized
        self._views = ViewLoader(capture, device)
        self._sampler = ViewSampler(capture.train, generator)
        self._background = _background(config, device)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.gaussians["means"])

    def describe(self) -> dict[str, float]:
        """How many Gaussians there are."""
        return {"triangles": self.count}

    def advance(self, first: int, last: int) -> list[float]:
        """All these steps; nothing waits for the device before the last."""
        return torch.stack([self._step(iteration) for iteration in range(first, last + 1)]).tolist()

    def refine(self, iteration: int) -> int:
        """Nothing: gsplat densifies within the steps."""
        return 0

    def review(self, progress: Progress) -> UndoEvent | None:
        """Nothing is ever undone."""
        return None

    def evaluate(self) -> dict[str, float]:
        """Nothing before the end."""
        return {}

    def first_not_finite(self) -> str | None:
        """The name of a parameter that holds NaN or infinity."""
        return next((name for name in NAMES if not bool(self.gaussians[name].isfinite().all())), None)

    def state(self) -> dict[str, Tensor]:
        """Everything but the random numbers of gsplat."""
        state = {f"sampler.{name}": tensor for name, tensor in self._sampler.state().items()}
        for name in NAMES:
            state[f"gaussians.{name}"] = parameter = self.gaussians[name]
            moments = self._optimizers[name].state[parameter]
            state |= {f"adam.{name}.{kind}": tensor for kind, tensor in moments.items()}
        strategy = {name: value for name, value in self._state.items() if isinstance(value, Tensor)}
        return state | {f"strategy.{name}": value for name, value in strategy.items()}

    def load_state(self, state: dict[str, Tensor], iteration: int) -> None:
        """Continues where `state` was taken."""
        self._sampler.load_state({name: state[f"sampler.{name}"] for name in self._sampler.state()})
        for name, optimizer in self._optimizers.items():
            parameter = nn.Parameter(state[f"gaussians.{name}"].to(self._device))
            self.gaussians[name] = parameter
            optimizer.param_groups[0]["params"] = [parameter]
            moments = self._under(f"adam.{name}.", state)
            optimizer.state[parameter] = moments
            if "step" in moments:
                moments["step"] = moments["step"].cpu()  # where torch's Adam counts
        self._state.update(self._under("strategy.", state))

    def _under(self, prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
        found = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        return {name: value.to(self._device) for name, value in found.items()}

    def _step(self, iteration: int) -> Tensor:
        """One view: draws, learns, densifies; returns the loss before it, on the device."""
        config, view = self._config, self._views.view(self._sampler.next_view())
        decay = exponential_decay(iteration, config.iterations, config.lr_means_final)
        self._optimizers["means"].param_groups[0]["lr"] = config.lr_means * decay
        regularized = (
            config.method == "2dgs" and config.lambda_normal > 0 and iteration > config.at(config.normals_from)
        )
        splatting = splat(
            self._gsplat,
            self.gaussians,
            view.camera,
            config,
            self._background,
            sh_degree=min(config.sh_degree, (iteration - 1) // config.at(config.sh_every)),
            normals=regularized,
        )
        loss = self._loss(splatting, view)
        step = iteration - 1  # gsplat counts from 0
        arguments = (self.gaussians, self._optimizers, self._state, step, splatting.info)
        self._strategy.step_pre_backward(*arguments)
        loss.backward()
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self._strategy.step_post_backward(*arguments, packed=False)
        if config.resets_after(iteration):
            # DefaultStrategy of 1.5.3 never does (its condition is false at every step); twice is the same as once.
            self._gsplat.strategy.ops.reset_opa(*arguments[:3], 2 * config.prune_opacity)
        return loss.detach()

    def _loss(self, splatting: Splatting, view: View) -> Tensor:
        loss = photometric_loss(
            splatting.color,
            view.photo,
            self._config.lambda_dssim,
            None if view.mask is None else view.mask.float() / 255,
            backgrounds=self._background,
        )
        if splatting.normals is None:
            return loss
        drawn, of_depth, alpha = splatting.normals
        return loss + self._config.lambda_normal * (1 - (drawn * of_depth * alpha.detach()).sum(dim=-1)).mean()


def _background(config: PeerConfig, device: torch.device) -> Tensor:
    return torch.full((1, 3), 1.0 if config.background == "white" else 0.0, device=device)
