"""What is run: every method of every preset, small. Options have the names of e629b5e; `names` translates them."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Case:
    """One command line.

    Attributes:
        name: of the case, and of its folder.
        command: what follows `etsplat`; paths are relative to the folder of the inputs (`inputs.py`).
        options: with the names of e629b5e.
        stop: how the run that is resumed ended (`runner.Job`).
    """

    name: str
    command: str
    options: str
    stop: Literal["kill", "interrupt"] = "kill"

    @property
    def task(self) -> Literal["reconstruct", "train"]:
        """Whose options these are."""
        return "train" if self.command.startswith(("train", "demo scene")) else "reconstruct"


_EVERY = "--log-every 10 --evaluate-every 40 --checkpoint-every 40"
_OWL = f"--preset tiny --resolution 48 --iterations 120 --chamfer-samples 2000 {_EVERY}"
# The larger presets: their weights, levels, untangling and rates, with few steps on few faces and pixels.
_SHRUNK = (
    "--resolution 64 --supersampling 2 --iterations 120 --start-level 2 --max-faces 1500 --subdivide-steps 4 "
    f"--gamma-hold 10 --lr-vertices 0.01 --chamfer-samples 2000 {_EVERY}"
)
_SCENE = f"--preset tiny --width 48 --iterations 120 --max-triangles 6000 {_EVERY}"
_SMALL = f"--width 48 --iterations 120 --max-triangles 6000 {_EVERY}"
# Plain PyTorch is slow.
_FEW = "--engine reference --iterations 15 --log-every 5 --evaluate-every 5 --checkpoint-every 5"
# So short a run would lose all triangles where there are few photos.
_KEPT = "--prune-importance 0.002 --lambda-opacity 0.0005"

CASES = (
    Case("owl-elastic", "demo", _OWL),
    Case("owl-bilateral", "demo", f"{_OWL} --method bilateral", "interrupt"),
    Case("owl-single-sided", "demo", f"{_OWL} --method single-sided"),
    Case("owl-raster-face", "demo", f"{_OWL} --method raster-face", "interrupt"),
    Case("owl-raster-vertex", "demo", f"{_OWL} --method raster-vertex"),
    Case("owl-vertex-colors", "demo", f"{_OWL} --colors vertex"),
    Case("owl-uniform", "demo", f"{_OWL} --vertex-update uniform"),
    Case("owl-large-steps", "demo", f"{_OWL} --vertex-update large-steps --large-steps-weight 5"),
    Case("owl-batch", "demo", f"{_OWL} --views-per-step 3 --seed 7"),
    Case("owl-sdf", "demo", f"{_OWL} --distance sdf --sigma-final 0.1"),
    Case("owl-weights", "demo", f"{_OWL} --lambda-normal 0.05 --lambda-edge 0.5 --lambda-laplacian 1 --lambda-sigma 0"),
    Case("owl-reference", "demo", f"{_OWL} --resolution 16 --max-faces 400 {_FEW}"),
    Case("owl-best", "demo", f"--preset best {_SHRUNK}", "interrupt"),
    Case("owl-paper", "demo", f"--preset paper {_SHRUNK}"),
    Case("owl-study", "demo", f"--preset study {_SHRUNK} --edge-power 2"),
    Case("owl-demo", "demo", f"--preset demo {_SHRUNK} --method single-sided"),
    Case("mesh-quick", "reconstruct blob.obj", f"--preset quick {_SHRUNK} --init-mesh start.obj", "interrupt"),
    Case("photos-masks", "reconstruct masked", f"{_OWL} --coarse-levels 1"),
    Case("photos-other-masks", "reconstruct rgba", f"{_OWL} --masks masked/masks --colors vertex"),
    Case("scene-elastic", "demo scene", _SCENE),
    Case("scene-bilateral", "demo scene", f"{_SCENE} --method bilateral", "interrupt"),
    Case("scene-single-sided", "demo scene", f"{_SCENE} --method single-sided"),
    Case("scene-not-frozen", "demo scene", f"{_SCENE} --method single-sided --no-freeze-incentre"),
    Case("scene-opaque", "demo scene", f"{_SCENE} --finish opaque", "interrupt"),
    Case("scene-sphere", "demo scene", f"{_SCENE} --sky-closed"),
    Case("scene-no-sky", "demo scene", f"{_SCENE} --no-sky-dome --background white --sample-by sharpness"),
    Case("scene-random", "demo scene", f"{_SCENE} --background random --no-replace-dead --sample-by opacity"),
    Case("scene-demo", "demo scene", f"--preset demo {_SMALL}"),
    Case("soup-reference", "train pointless", f"{_SCENE} --width 16 --start-points 200 --max-triangles 300 {_FEW}"),
    Case("scene-paper", "demo scene", f"--preset paper {_SMALL}", "interrupt"),
    Case("scene-paper-indoor", "demo scene", f"--preset paper --scene-type indoor {_SMALL}"),
    Case("scene-paper-object", "demo scene", f"--preset paper --scene-type object {_SMALL} --regularize-from 5000"),
    Case("scene-paper-sided", "demo scene", f"--preset paper --method single-sided {_SMALL} --lambda-distortion 0.1"),
    Case(
        "soup-quick",
        "train rgba",
        f"--preset quick --scene-type object {_SMALL} {_KEPT} --background random --lr-vertices 0.0004",
    ),
    Case("soup-indoor", "train rgba", f"--preset quick --scene-type indoor {_SMALL}"),
    Case(
        "soup-masks", "train masked", f"{_SCENE} --prune-importance 0 --prune-opacity 0.001 --max-epochs 9", "interrupt"
    ),
    Case("soup-other-masks", "train rgba", f"{_SCENE} --masks masked/masks --sky-closed"),
    Case("soup-pointless", "train pointless", f"{_SCENE} {_KEPT} --start-points 800", "interrupt"),
)

CONTROLS = ("owl-elastic", "scene-elastic")
"""Run once more with one bit of one parameter flipped in the middle; the comparison must find it."""
