"""A strategy of one's own: faces are divided where photos look, not where they are largest.

All photos are taken from the front. The picture shows the front: largest faces divided, own strategy, what is there.

    python examples/05_own_strategy.py --out strategy.png
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace

import torch

import etsplat


class DivideWhatIsSeen(etsplat.Strategy):
    """Divides the faces that are largest on any photo."""

    outputs = ("statistics",)  # of every picture: how large each face is on it, in pixels, and more

    def __init__(self, budgets: Mapping[int, int]) -> None:
        self._budgets = budgets  # by iteration, how many faces there may be after it
        self._largest = torch.zeros(())

    def observe(self, seen: etsplat.Rasterization, *, epoch_starts: bool) -> None:
        """Called with each picture of a step."""
        assert seen.statistics is not None
        self._largest = torch.maximum(self._largest, seen.statistics.screen_size[0])

    def edit(self, iteration: int) -> bool:
        """Called after each step; says whether it changed the model."""
        if iteration not in self._budgets:
            return False
        mesh, most = self.model, self._budgets[iteration]
        plan = etsplat.longest_edge_plan(mesh.vertices.detach(), mesh.topology, self._largest, most)
        # Parameters and Adam's moments of the new faces come from those that were divided.
        names = {"per_vertex": mesh.vertex_parameters, "per_face": mesh.face_parameters}
        mesh.load_state({**etsplat.apply_subdivision(plan, self.adam, **names), "faces": plan.faces})
        self._largest = torch.zeros(())
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--out", default="strategy.png")
    options = parser.parse_args()

    photos = etsplat.photograph(etsplat.demo_object(), 128, 128, elevations=(0.0, 30.0), azimuths=16)
    front = [view for view in range(len(photos)) if photos.centers[view, 2] > 1.5]
    photos = replace(photos, train=front[1:], test=front[:1])
    camera, truth = photos.cameras[photos.test[0]], photos.images[photos.test[0]][..., :3]
    budgets = {options.iterations * k // 8: 320 * 2**k for k in (1, 2, 3)}
    pictures = []
    for strategy in (etsplat.SubdivideAndUntangle(budgets), DivideWhatIsSeen(budgets)):
        vertices, faces = etsplat.icosphere(2)
        mesh = etsplat.TriangleMesh.from_mesh(vertices, faces, colors=0.7, opacity=0.98, sigma=0.25)
        objective = etsplat.Objective(etsplat.Photometric(), [etsplat.EdgeLength(0.5), etsplat.Laplacian(0.2)])
        faster = etsplat.Schedule({**mesh.rates, "vertices": 1e-2})
        trainer = etsplat.Trainer(mesh, photos, objective, strategy, schedule=faster)
        trainer.fit(options.iterations, callbacks=[print], log_every=200)
        pictures.append(mesh.render(camera).color[0].detach())
        print(f"{type(strategy).__name__}: {mesh.count} faces, PSNR {etsplat.psnr(pictures[-1], truth):.1f} dB")
    etsplat.save_image(options.out, torch.cat([*pictures, truth], dim=1))


if __name__ == "__main__":
    main()
