"""Polygons with dents: the triangles that they are cut into fill them, and nothing beside them."""

import struct

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io._polygons import ears
from etsplat.io.mesh_files import MeshFile, load_mesh

L_SHAPE = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]
"""Of area 3; the fan from its first corner covers more."""


def area(mesh: MeshFile) -> float:
    a, b, c = mesh.vertices[mesh.faces].double().unbind(1)
    return float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)


def write(path, corners, order) -> None:
    points = [f"{x} {y} 5" for x, y in corners]
    if path.suffix == ".obj":
        path.write_text("".join(f"v {p}\n" for p in points) + "f " + " ".join(str(k + 1) for k in order) + "\n")
    else:
        text = "\n".join([f"OFF\n{len(points)} 1 0", *points, f"{len(order)} " + " ".join(map(str, order))])
        path.write_text(text + "\n")


@pytest.mark.parametrize("name", ["a.obj", "a.off"])
@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("first", range(6))
def test_a_polygon_with_a_dent_is_filled_from_whichever_corner_it_begins(tmp_path, name, step, first):
    write(tmp_path / name, L_SHAPE, np.roll(np.arange(6), first)[::step])
    mesh = load_mesh(tmp_path / name)
    assert len(mesh.faces) == 4
    assert area(mesh) == pytest.approx(3)
    assert mesh.notes[0] == "1 polygons were cut into 4 triangles"


def test_a_quadrilateral_with_a_dent_keeps_the_place_of_its_texture(tmp_path):
    """Its texture coordinates are its corners, before and after."""
    corners = [(0, 0), (4, 0), (1, 1), (0, 4)]
    order = [2, 3, 4, 1]  # the fan from the second corner leaves the dent outside
    Image.new("RGB", (2, 2)).save(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd a.png\n")
    points = "".join(f"v {x} {y} 0\nvt {x} {y}\n" for x, y in corners)
    face = " ".join(f"{k}/{k}" for k in order)
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{points}usemtl a\nf {face}\n")
    mesh = load_mesh(tmp_path / "a.obj")
    assert area(mesh) == pytest.approx(4)
    assert mesh.texture is not None
    torch.testing.assert_close(mesh.texture.corner_uvs, mesh.vertices[mesh.faces][..., :2])


def test_polygons_without_dents_are_cut_into_fans(tmp_path):
    """Also one that is not flat."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0.2\nv 1 1 0\nv 0 1 0.2\nf 2 3 4 1\n")
    assert load_mesh(tmp_path / "a.obj").faces.tolist() == [[1, 2, 3], [1, 3, 0]]


def test_a_polygon_that_crosses_itself_is_read_all_the_same(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 3 0 0\nv 3 3 0\nv 1 -1 0\nv 1 3 0\nf 1 2 3 4 5\n")
    assert len(load_mesh(tmp_path / "a.obj").faces) == 3


@pytest.mark.parametrize("seed", range(20))
def test_ears_fill_any_star(seed):
    """In any plane: no triangle is turned over, and together they have the polygon's area."""
    random = np.random.default_rng(seed)
    count = int(random.integers(5, 40))
    angles = 2 * np.pi * (np.arange(count) + random.uniform(0, 0.9, count)) / count
    radii = random.uniform(0.1, 1, count)
    turned = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0 * radii], axis=1) @ turned.T
    areas = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    found = ears(points, areas)
    assert found is not None
    a, b, c = (points[found[:, corner]] for corner in range(3))
    parts = np.cross(b - a, c - a)
    assert found.shape == (count - 2, 3)
    np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), np.linalg.norm(areas), rtol=1e-9)
    np.testing.assert_allclose(parts.sum(axis=0), areas, atol=1e-9)


FACES = ([0, 5, 6], [4, 5, 0, 1], [0, 1, 2, 3, 4, 5])
"""A triangle, a quad and the L-shape, from a corner whose fan does not fill it."""
COLORS = ([255, 0, 0], [0, 255, 0], [0, 0, 255])


def ply(path, faces, kind: str) -> None:
    """Colours of faces; corners in doubles."""
    points = np.array([*L_SHAPE, (3, 0)], dtype=float)
    points = np.concatenate([points, np.full((len(points), 1), 5.0)], axis=1)
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[kind]
    head = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\n" + "".join(
        f"property double {axis}\n" for axis in "xyz"
    )
    head += f"element face {len(faces)}\nproperty list uchar int vertex_index\n"
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    if kind:
        body = points.astype(kind + "f8").tobytes()
        for face, color in zip(faces, COLORS, strict=False):
            body += bytes([len(face)]) + np.array(face, kind + "i4").tobytes() + bytes(color)
    else:
        rows = [*points.tolist(), *([len(face), *face, *color] for face, color in zip(faces, COLORS, strict=False))]
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    path.write_bytes(head.encode() + body)


@pytest.mark.parametrize("kind", ["", "<", ">"])
@pytest.mark.parametrize("chosen", [(0, 1, 2), (1,), (2,), (0, 2), (1, 0)])
def test_polygons_of_a_ply_are_cut_and_keep_their_colours(tmp_path, kind, chosen):
    """Triangles and others in one binary file, as Blender writes them, were said to be cut short."""
    ply(tmp_path / "a.ply", [FACES[k] for k in chosen], kind)
    mesh = load_mesh(tmp_path / "a.ply")
    counts = [len(FACES[k]) - 2 for k in chosen]
    assert mesh.face_colors is not None
    colors = np.repeat(np.array(COLORS[: len(chosen)]) / 255, counts, axis=0)
    np.testing.assert_allclose(mesh.face_colors.numpy(), colors, atol=1e-6)
    assert area(mesh) == pytest.approx(sum({0: 0.5, 1: 1.5, 2: 3.0}[k] for k in chosen))
    assert mesh.notes[0] == f"{len(chosen)} polygons were cut into {sum(counts)} triangles"


@pytest.mark.parametrize("kind", ["", "<"])
def test_a_ply_of_polygons_that_is_cut_short_or_has_edges_for_faces_is_an_input_error(tmp_path, kind):
    ply(tmp_path / "a.ply", FACES, kind)
    data = (tmp_path / "a.ply").read_bytes()
    for missing in (40, 20):
        (tmp_path / "a.ply").write_bytes(data[:-missing])
        with pytest.raises(InputError, match=r"a\.ply"):
            load_mesh(tmp_path / "a.ply")
    ply(tmp_path / "a.ply", [[0, 1, 2], [0, 1]], kind)
    with pytest.raises(InputError, match="a face with 2 corners"):
        load_mesh(tmp_path / "a.ply")


def test_a_ply_whose_corners_are_no_list_is_an_input_error(tmp_path):
    """A byte that is no space in the header, as of a file that was damaged, ended in numpy's words."""
    ply(tmp_path / "a.ply", FACES, "<")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"list uchar", b"list\0uchar"))
    with pytest.raises(InputError, match=r"a\.ply"):
        load_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_strips_of_a_ply_are_triangles_that_all_look_one_way(tmp_path, kind):
    """As some scans have them; they were refused as clouds of points without faces."""
    corners = torch.tensor([[x, y, 0.0] for x in range(4) for y in (0.0, 1.0)])
    strips = [0, 2, 1, 3, -1, 2, 4, 3, 5, 5, 4, 4, 6, 5, 7]  # two, in the second of which corners come twice
    head = f"ply\nformat {kind} 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    if kind == "ascii":
        rows = [" ".join(str(number) for number in place) for place in corners.tolist()]
        body = "\n".join([*rows, " ".join(map(str, [len(strips), *strips]))]).encode()
    else:
        order = "<" if kind == "binary_little_endian" else ">"
        body = struct.pack(f"{order}24f", *corners.flatten().tolist())
        body += struct.pack(f"{order}{1 + len(strips)}i", len(strips), *strips)
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    mesh = load_mesh(tmp_path / "a.ply")
    assert (len(mesh.faces), mesh.notes) == (6, ())
    places = mesh.vertices[mesh.faces]
    areas = torch.linalg.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])[:, 2] / 2
    assert areas.tolist() == [0.5] * 6
