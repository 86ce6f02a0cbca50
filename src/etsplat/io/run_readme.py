"""README.txt of run directories: what is in them."""

from etsplat.core.spelling import either, option

_README = """\
This folder is a run of etsplat ({task}).

report.html     the whole result on one page; opens in any browser, without a network
{results}
metrics.json    how good it is; docs/conventions.md of etsplat says how each number is measured
{test}
history.jsonl   one line per log step: iteration, seconds of optimisation, loss, state, and what was evaluated
convergence.png how loss, quality and the number of triangles went; overview.png shows test views
exposure.json   if it is there: the photos were exposed unlike each other; how each saw the colours of the result
cameras.json    if it is there: cameras of the training photos as they were refined, and how far each moved
georeference.json  if it is there: world coordinates = offset + scale * coordinates of the result, before it was turned
ended.txt       if it is there: how the run ended before it was done
config.json     the settings that made it
checkpoints/    where an interrupted run continues {again}; safe to delete once the run is done
blocks/         if it is there: a run for each block of the scene, with its checkpoints; as safe to delete at the end
stages/         if it is there: the same of what was made beside it; as safe to delete
"""

_RESULTS = {
    "reconstruct": """\
mesh.glb        the result, for viewers
mesh.obj, .ply  the same; colours of faces are exact in mesh.ply, and means at the vertices in all three
textured.glb    if it is there: few faces under a texture, of {texture}""",
    "train": """\
soup.safetensors  the result: triangles with opacity, softness and view-dependent colour; etsplat export converts it
opaque.glb      if it is there: the scene as opaque triangles, for every mesh viewer and game engine
opaque.safetensors  the same in the units and axes of the capture""",
    "fit": """\
                (whoever called Trainer.fit saves the model)""",
}

_TEST = {
    "reconstruct": """\
test/           held-out views: NNN_render.png (splatted), NNN_truth.png, NNN_mesh.png (the mesh drawn opaque)""",
    "train": """\
test/           held-out views: NNN_render.png (splatted), NNN_truth.png, NNN_opaque.png (drawn opaque)""",
    "fit": """\
test/           held-out views, where somebody scored them""",
}

_PEER_README = """\
This folder is a run of a peer of etsplat, in gsplat.

gaussians.safetensors  the result: Gaussians as gsplat has them, where the cameras are centred and their extent is 1
metrics.json    how good it is; evaluation.json has more, and the speed
test/           held-out views: NNN_render.png, NNN_truth.png
history.jsonl   one line per log step: iteration, seconds of optimisation, loss, number of Gaussians
config.json     the settings that made it
checkpoints/    where an interrupted run continues; safe to delete once the run is done
"""


def readme_of(task: str) -> str:
    """The text for a run of a task: "reconstruct", "train", "fit" or "peer"."""
    if task == "peer":
        return _PEER_README
    again = "when Trainer.fit is called for it again" if task == "fit" else f"with {option('resume', True)}"
    texture = either("--texture or of etsplat export --texture", "texture= or of etsplat.texture_mesh")
    results = _RESULTS[task].format(texture=texture)
    return _README.format(task=task, results=results, test=_TEST[task], again=again)
