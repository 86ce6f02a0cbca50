"""Objects that no setting was chosen by: solids made in code, photographed by Blender's path tracer.

    PYTHON -m benchmarks.unseen_objects chair vase --out FOLDER
    python -m studies.gallery --inputs FOLDER --out RUNS

PYTHON has bpy (5.0), numpy, scikit-image and trimesh; of etsplat it needs nothing. Each object becomes a capture as
NeRF synthetic has them, 56 training and 8 test views of 400 x 400 with transparency, and mesh.obj, its true surface:
a few minutes each on one core. Colours are noise in three tones, gloss and tones by the object's name.
"""

import argparse
import json
import math
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
import trimesh
from mathutils import Matrix, Vector  # pyright: ignore[reportMissingImports]

from benchmarks.unseen_objects.household import SHAPES
from benchmarks.unseen_objects.surfaces import surface

VIEWS = {"train": (56, -60, 80, 16), "test": (8, -45, 65, 32)}
"""How many, lowest and highest elevation in degrees, paths for each pixel."""

ANGLE, DISTANCE = math.pi / 4, 3.35


def material(rng: np.random.Generator):
    """Noise in three tones."""
    made = bpy.data.materials.new("tones")
    made.use_nodes = True
    nodes, links, shader = made.node_tree.nodes, made.node_tree.links, made.node_tree.nodes["Principled BSDF"]
    places, noise, ramp = (nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "TexNoise", "ValToRGB"))
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 4 + 6 * rng.random(), 6
    ramp.color_ramp.elements.new(0.5)
    for element, position in zip(ramp.color_ramp.elements, (0.35, 0.5, 0.65), strict=True):
        element.position, element.color = position, (*(0.05 + 0.7 * rng.random(3)), 1)
    shader.inputs["Roughness"].default_value = 0.3 + 0.4 * rng.random()
    links.new(places.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return made


def stage(mesh: trimesh.Trimesh, rng: np.random.Generator):
    """The scene with the object, a pale sky, two panels and a soft sun."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    shape = bpy.data.meshes.new("object")
    shape.from_pydata(mesh.vertices.tolist(), [], mesh.faces.tolist())
    shape.shade_smooth()
    shape.materials.append(material(rng))
    scene.collection.objects.link(bpy.data.objects.new("object", shape))
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    sky = scene.world.node_tree.nodes["Background"]
    sky.inputs[0].default_value, sky.inputs[1].default_value = (0.7, 0.8, 1, 1), 0.6
    for kind, place, energy, size in (
        ("AREA", (3, -3, 4), 250, 2),
        ("AREA", (-4, 2, 2), 120, 2),
        ("SUN", (1, 2, 3), 1.5, 0.2),
    ):
        light = bpy.data.lights.new(kind, kind)
        light.energy = energy
        setattr(light, "angle" if kind == "SUN" else "size", size)
        lamp = bpy.data.objects.new(kind, light)
        lamp.location, lamp.rotation_euler = place, (-Vector(place)).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(lamp)
    return scene


def prepare(scene) -> None:
    """Rendering, and a camera."""
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device, cycles.max_bounces, cycles.use_denoising = "CYCLES", "CPU", 2, False
    render.film_transparent, render.use_persistent_data = True, True
    render.resolution_x = render.resolution_y = 400
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"
    lens = bpy.data.cameras.new("camera")
    lens.angle = ANGLE
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)


def pose(number: int, count: int, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """Camera to world: evenly spread over a band of the sphere, aimed a little off, a little rolled."""
    sines = [math.sin(math.radians(angle)) for angle in (low, high)]
    up, around = math.asin(sines[0] + (number + 0.5) / count * (sines[1] - sines[0])), 2.399963 * number
    out = np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])
    eye, aim = DISTANCE * (1 + rng.uniform(-0.15, 0.15)) * out, rng.uniform(-0.03, 0.03, 3)
    back = (eye - aim) / np.linalg.norm(eye - aim)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    roll, above = math.radians(rng.uniform(-4, 4)), np.cross(back, right)
    matrix = np.eye(4)
    matrix[:3, 0] = math.cos(roll) * right + math.sin(roll) * above
    matrix[:3, 1] = math.cos(roll) * above - math.sin(roll) * right
    matrix[:3, 2], matrix[:3, 3] = back, eye
    return matrix


def photograph(name: str, folder: Path) -> None:
    """Writes a capture."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh, rng = surface(name), np.random.default_rng(sum(map(ord, name)))
    mesh.export(folder / "mesh.obj")
    scene = stage(mesh, rng)
    prepare(scene)
    for split, (count, low, high, paths) in VIEWS.items():
        scene.cycles.samples, frames = paths, []
        for number in range(count):
            matrix = pose(number, count, low, high, rng)
            scene.camera.matrix_world = Matrix(matrix.tolist())
            scene.render.filepath = str((folder / split / f"r_{number}.png").resolve())
            bpy.ops.render.render(write_still=True)
            frames.append({"file_path": f"./{split}/r_{number}", "transform_matrix": matrix.tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
    print(f"{name}: {len(mesh.faces):,} faces, Euler number {mesh.euler_number}, {mesh.body_count} parts", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=list(SHAPES))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    for name in options.names:
        photograph(name, options.out / name)


if __name__ == "__main__":
    main()
