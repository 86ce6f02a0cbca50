"""The files that are changed: small ones of every kind, all made here."""

import base64
import io
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import trimesh
from PIL import Image

import etsplat
from etsplat.io.camera_path_files import KeyPoses
from etsplat.io.compact_soups import encode_compact
from etsplat.io.georeference import Georeference
from etsplat.io.kernel_files import write_kernel
from etsplat.io.mesh_files import MeshFile
from etsplat.io.opaque_files import save_opaque
from etsplat.io.ply_tables import encode_ply
from etsplat.io.refined_camera_files import RefinedCamera, write_refined_cameras
from etsplat.io.textures import Texture
from etsplat.model.solid_soup import SolidSoup
from etsplat.model.soup_compact import compact_of
from etsplat.optim.checkpoints import save_checkpoint
from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.export_soup import export_soup
from etsplat.tasks.opened_runs import SoupRun
from helpers import foreign_captures
from helpers.captures import write_colmap, write_transforms
from helpers.photos import upright_picture, write_phone_photo

RUN_HASH = "0123456789abcdef"

Files = dict[str, bytes]
"""Contents by path in a folder."""


def made(write: Callable[[Path], object]) -> Files:
    """What a function writes into an empty folder."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def meshes(suffix: str) -> list[bytes]:
    """An icosahedron without colours, with those of vertices and with those of faces, as the library writes it."""
    vertices, faces = etsplat.icosphere(0)
    rng = torch.Generator().manual_seed(0)
    kinds = ({}, {"vertex_colors": torch.rand(12, 3, generator=rng)}, {"face_colors": torch.rand(20, 3, generator=rng)})
    name = f"mesh{suffix}"
    return [
        made(lambda folder, colors=colors: etsplat.save_mesh(folder / name, vertices, faces, **colors))[name]
        for colors in kinds
    ]


def packed_glbs() -> list[bytes]:
    """Quantised with colours; compressed where the package is; with a picture in WebP."""
    vertices, faces = etsplat.icosphere(1)
    picture, uvs = torch.arange(48, dtype=torch.uint8).reshape(4, 4, 3), vertices[faces][..., :2].abs()
    skin = {"texture": Texture.of([picture], torch.zeros(80, dtype=torch.int64), uvs)}
    kinds = [{"compress": "quantize", "vertex_colors": 0.5 + 0.5 * vertices}, {**skin, "pictures": "webp"}]
    if find_spec("meshoptimizer") is not None:
        kinds += [{"compress": "meshopt"}, {**skin, "compress": "meshopt"}]
    return [made(lambda at, k=k: etsplat.save_mesh(at / "a.glb", vertices, faces, **k))["a.glb"] for k in kinds]


def objs() -> list[bytes]:
    """As other programs write them too: normals and textures, quads, indices from the end, a line that goes on."""
    cube = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    other = (
        f"# cube\no cube\n{cube}vt 0 0\nvn 0 0 1\ns off\nf 1/1/1 2/1/1 4/1/1 3/1/1\nf 5//1 6//1 8//1\nf -8 -7 -3 -4\n"
    )
    return [*meshes(".obj"), other.encode()]


def plys() -> list[bytes]:
    """ASCII and binary, of both orders of bytes, with colours and a polygon."""
    vertices, faces = etsplat.icosphere(0)
    points, corners = vertices.numpy(), faces.numpy()
    kinds = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    found = meshes(".ply")
    for kind, order in kinds.items():
        header = (
            f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex 12\nproperty float x\nproperty float y\n"
            "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 20\n"
            "property list uchar int vertex_indices\nend_header\n"
        )
        if order is None:
            body = "".join(f"{x} {y} {z} 255 128 0\n" for x, y, z in points.tolist())
            found.append((header + body + "".join(f"3 {a} {b} {c}\n" for a, b, c in corners.tolist())).encode())
        else:
            rows = [struct.pack(f"{order}3f3B", *point, 255, 128, 0) for point in points.tolist()]
            rows += [struct.pack(f"{order}B3i", 3, *face) for face in corners.tolist()]
            found.append(header.encode() + b"".join(rows))
    return found


def offs() -> list[bytes]:
    vertices, faces = etsplat.icosphere(0)
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in vertices.tolist())
    corners = faces.tolist()
    colored = "".join(f"3 {a} {b} {c} 255 128 {10 * k}\n" for k, (a, b, c) in enumerate(corners))
    plain = "".join(f"3 {a} {b} {c}\n" for a, b, c in corners)
    return [
        f"OFF\n{comment}12 20 0\n{rows}{part}".encode() for comment, part in (("# made here\n", colored), ("", plain))
    ]


def stls() -> list[bytes]:
    vertices, faces = etsplat.icosphere(0)
    corners = vertices[faces].numpy().astype("<f4")
    rows = [struct.pack("<3f", 0, 0, 1) + triangle.tobytes() + b"\0\0" for triangle in corners]
    text = "solid made\n"
    for triangle in corners.tolist():
        lines = "".join(f"      vertex {x} {y} {z}\n" for x, y, z in triangle)
        text += f"  facet normal 0 0 1\n    outer loop\n{lines}    endloop\n  endfacet\n"
    return [b"\0" * 80 + struct.pack("<I", 20) + b"".join(rows), (text + "endsolid made\n").encode()]


def gltfs() -> list[bytes]:
    """The GLB with its buffer as base64 in the text."""
    found = []
    for glb in meshes(".glb")[:2]:
        length = struct.unpack_from("<I", glb, 12)[0]
        document, buffer = json.loads(glb[20 : 20 + length]), glb[28 + length :]
        uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
        document["buffers"] = [{"byteLength": len(buffer), "uri": uri}]
        found.append(json.dumps(document).encode())
    return found


def textured_obj() -> Files:
    """Two materials with a picture, one of them with options, and one with a colour."""
    cube = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    corners = "vt 0 0\nvt 1 0\nvt 1 1\nvt -0.5 2.5\n"
    faces = "usemtl wood\nf 1/1 2/2 4/3 3/4\nusemtl stone\nf 5/1 6/2 8/3\nusemtl paint\nf -8 -7 -3\n"
    materials = (
        "newmtl wood\nKd 0.2 0.4 0.6\nmap_Kd wood.png\nmap_Bump wood.png\n"
        "newmtl stone\nmap_Kd -s 2 2 1 -clamp on wood.png\nnewmtl paint\nKd 1 0.5 0\n"
    )
    return {
        "input.obj": f"mtllib cube.mtl\n{cube}{corners}{faces}".encode(),
        "cube.mtl": materials.encode(),
        "wood.png": pictures()[0],
    }


def textured_gltfs() -> list[Files]:
    """With its picture within, and with files beside it."""
    vertices, faces = etsplat.icosphere(0)
    uv = vertices.numpy()[:, :2] + 0.5
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.open(io.BytesIO(pictures()[0])), baseColorFactor=[255, 128, 64, 255]
    )
    mesh = trimesh.Trimesh(
        vertices.numpy(), faces.numpy(), visual=trimesh.visual.TextureVisuals(uv, material=material), process=False
    )
    parts = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh))
    beside = {"input.gltf" if name.endswith(".gltf") else name: bytes(data) for name, data in parts.items()}
    return [{"input.glb": trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh))}, beside]


def pictures() -> list[bytes]:
    """PNG of every mode, JPEG of three."""
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
    found = []
    modes = [("PNG", mode) for mode in ("RGB", "RGBA", "L", "LA", "P", "1", "I;16")]
    for kind, mode in [*modes, ("JPEG", "RGB"), ("JPEG", "L"), ("JPEG", "CMYK")]:
        whole = Image.fromarray(pixels)
        if mode == "I;16":
            image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 200)
        else:
            image = whole.convert("RGB").convert(mode) if mode in ("CMYK", "P", "1") else whole.convert(mode)
        memory = io.BytesIO()
        image.save(memory, kind)
        found.append(memory.getvalue())
    return found


def phone_photos(suffix: str) -> list[bytes]:
    """On their side and upright, with EXIF."""
    name = f"photo{suffix}"
    tags = {"model": "Phone 7", "focal_mm": 4.25, "focal_35mm": 28}
    return [
        made(lambda folder, o=o: write_phone_photo(folder / name, upright_picture(), o, **tags))[name] for o in (1, 6)
    ]


def masks() -> list[bytes]:
    found = []
    for values in (np.eye(12, 16) > 0, np.ones((12, 16)) > 0):
        memory = io.BytesIO()
        Image.fromarray((255 * values).astype(np.uint8)).save(memory, "PNG")
        found.append(memory.getvalue())
    return found


def colmap_text() -> Files:
    return made(lambda folder: write_colmap(folder, [(16, 12)] * 4))


def colmap_binary() -> Files:
    """The same model as `colmap_text`."""
    files = colmap_text()
    model = {}
    for name in ("cameras", "images", "points3D"):
        lines = [line.split() for line in files.pop(f"sparse/0/{name}.txt").decode().splitlines() if line]
        rows = [struct.pack("<Q", len(lines))]
        for words in lines:
            if name == "cameras":
                rows.append(struct.pack("<iiQQ4d", int(words[0]), 1, *map(int, words[2:4]), *map(float, words[4:])))
            elif name == "images":
                rows.append(struct.pack("<I7dI", int(words[0]), *map(float, words[1:8]), int(words[8])))
                rows.append(words[9].encode() + b"\0" + struct.pack("<Q2dq", 1, 3.0, 4.0, -1))
            else:
                numbers = int(words[0]), *map(float, words[1:4]), *map(int, words[4:7]), float(words[7])
                rows.append(struct.pack("<Q3d3BdQ2i", *numbers, 1, 0, 0))
        model[f"sparse/0/{name}.bin"] = b"".join(rows)
    return {**files, **model}


def transforms(**settings: object) -> Files:
    return made(lambda folder: write_transforms(folder, 4, cx=8.0, cy=6.0, fl_y=16.0, **settings))


def transforms_with_points() -> Files:
    files = transforms(ply_file_path="points.ply", train_filenames=["images/0000.png"], test_filenames=[])
    return {**files, "points.ply": point_clouds()[0]}


def blender() -> Files:
    """NeRF-synthetic: an angle for the focal length, names without endings, RGBA, a file for each split."""
    files = made(lambda folder: write_transforms(folder, 4, channels=4))
    document = json.loads(files.pop("transforms.json"))
    frames = [{**frame, "file_path": "./" + frame["file_path"][:-4]} for frame in document["frames"]]
    for name, chosen in (("train", frames[:3]), ("test", frames[3:])):
        text = json.dumps({"camera_angle_x": 0.8, "frames": chosen}).encode()
        files[f"transforms_{name}.json"] = text
    return files


def foreign(kind: str) -> Files:
    """A small capture as another program writes it; see `helpers.foreign_captures.WRITERS`."""
    return made(lambda folder: foreign_captures.WRITERS[kind](folder, foreign_captures.truth(3)))


def georeferences() -> list[bytes]:
    far = (500_000.25, 5_400_000.5, 300.0)
    return [found.to_json().encode() for found in (Georeference(far), Georeference(far, 0.5, "z", "EPSG:25832"))]


def point_clouds() -> list[bytes]:
    rng = np.random.default_rng(0)
    plain = np.zeros(6, dtype=[(axis, "<f4") for axis in "xyz"])
    colored = np.zeros(6, dtype=[*plain.dtype.descr, *((name, "u1") for name in ("red", "green", "blue"))])
    for table in (plain, colored):
        for name in table.dtype.names or ():
            table[name] = rng.integers(0, 200, 6)
    return [encode_ply({"vertex": colored}), encode_ply({"vertex": plain})]


def gaussians() -> list[bytes]:
    """Gaussian scenes as 3DGS writes them, of degree 3 and 0."""
    rng, found = np.random.default_rng(0), []
    for rest in (45, 0):
        names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(rest))]
        names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
        table = np.zeros(5, dtype=[(name, "<f4") for name in names])
        for name in names:
            table[name] = rng.normal(size=5)
        found.append(encode_ply({"vertex": table}))
    return found


def soup(degree: int = 1, kernel: str = "elastic") -> etsplat.TriangleSoup:
    rng = torch.Generator().manual_seed(0)
    start = etsplat.TriangleSoup.from_triangles(
        torch.randn(6, 3, 3, generator=rng), torch.rand(6, 3, generator=rng), opacity=0.8, sigma=0.5, sh_degree=degree
    )
    return replace(start, **start.state(), appearance=etsplat.SoupAppearance(kernel), notes={"source": "made here"})


def soups() -> list[bytes]:
    return [made(lambda f, s=s: s.save(f / "s.safetensors"))["s.safetensors"] for s in (soup(), soup(0, "bilateral"))]


def opaque_meshes() -> list[bytes]:
    mesh = MeshFile(torch.rand(5, 3), torch.tensor([[0, 1, 2], [2, 3, 4]]), vertex_colors=torch.rand(5, 3))
    return [made(lambda f: save_opaque(f / "o.safetensors", mesh))["o.safetensors"]]


def camera_paths() -> list[bytes]:
    """Poses of many digits, as the viewer saves them."""
    poses = etsplat.orbit_cameras(8, 8, elevations=(20.0,), azimuths=12).viewmats.double()
    fovs = torch.linspace(40.3, 60.7, 12, dtype=torch.float64)
    return [KeyPoses(poses, fovs, aspect).to_json().encode() for aspect in (None, 1.5)]


def refined_cameras() -> Files:
    pose, K = torch.eye(4).tolist(), [[90.0, 0.0, 32.0], [0.0, 91.0, 24.0], [0.0, 0.0, 1.0]]
    cameras = {name: RefinedCamera(pose, K, 64, 48, name != "b", 0.4, 0.02, 0.01) for name in ("a", "b")}
    return made(lambda f: write_refined_cameras(f, cameras))


def exported() -> list[bytes]:
    """PLY of `etsplat export`, with all its numbers."""
    config = ExportConfig(colors="keep", up="keep", alpha=False)
    run = SoupRun(path=Path("soup"), soup=soup(), capture=None)
    plain = ExportConfig(colors="constant", up="keep")
    return [made(lambda f, c=c: export_soup(run, f / "s.ply", c))["s.ply"] for c in (config, plain)]


def compact_soups() -> list[bytes]:
    """A soft one, and the opaque mesh of a page."""
    soft = compact_of(soup(), torch.arange(6.0))
    solid = SolidSoup.of_corners(soup().vertices, torch.rand(6, 3, 3), etsplat.SoupAppearance(), {})
    return [encode_compact(soft), encode_compact(compact_of(solid, torch.arange(6.0)))]


def states() -> list[bytes]:
    """Triangle Splatting's point_cloud_state_dict.pt."""
    s = soup(3).state()
    state = {
        "triangles_points": s["vertices"],
        "sigma": s["sigma_raw"][:, None],
        "opacity": s["opacity_logits"][:, None],
        "features_dc": s["sh_dc"],
        "features_rest": s["sh_rest"],
        "active_sh_degree": 3,
    }
    memory = io.BytesIO()
    torch.save(state, memory)
    return [memory.getvalue()]


def weights() -> list[bytes]:
    """Some tensors by name."""
    memory = io.BytesIO()
    torch.save({"features.0.weight": torch.rand(2, 3), "lin0.model.1.weight": torch.rand(4).half()}, memory)
    return [memory.getvalue()]


def kernels() -> list[bytes]:
    etsplat.register_kernel("fuzzed", lambda x, sigma: torch.sigmoid((1 - x) / (0.25 * sigma)))
    return [made(lambda folder: write_kernel(folder, "fuzzed"))["kernel.safetensors"]]


def checkpoints() -> list[bytes]:
    state = {**soup().state(), "adam.count": torch.tensor(3), "rng": torch.arange(10, dtype=torch.uint8)}
    files = made(lambda folder: save_checkpoint(folder, 3, state, RUN_HASH))
    return list(files.values())


def run() -> Files:
    """The folder of a finished run of `etsplat train`, and its scene."""

    def write(folder: Path) -> None:
        write_transforms(folder / "scene", 8)
        config = etsplat.TrainConfig.tiny().changed({"iterations": 6})
        etsplat.train(folder / "scene", folder / "run", config)

    return made(write)


def config_files() -> list[bytes]:
    """For --config: some settings, and a run's own."""
    some = {"preset": "demo", "iterations": 100, "optimizer": {"lr_vertices": 0.01}, "method": "bilateral"}
    return [json.dumps(some).encode(), run()["run/config.json"]]


def depth_maps() -> list[Files]:
    """Of every kind, with unknown places."""
    depth = np.random.default_rng(0).uniform(0.5, 4.0, (9, 12)).astype(np.float32)
    depth[2:4] = 0.0
    npy, png = io.BytesIO(), io.BytesIO()
    np.save(npy, depth)
    Image.fromarray((1000 * depth).astype(np.uint16)).save(png, format="PNG")

    def exr(path: Path) -> None:
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Z": depth}).write(str(path / "input.exr"))

    return [{"input.npy": npy.getvalue()}, {"input.png": png.getvalue()}, made(exr)]


def laser_scans() -> list[Files]:
    """LAS, with colours and without."""
    import laspy

    found = []
    for kind in (3, 0):
        cloud = laspy.LasData(laspy.LasHeader(point_format=kind, version="1.2"))
        cloud.x, cloud.y, cloud.z = np.random.default_rng(0).normal(size=(3, 40))
        if kind == 3:
            cloud.red = cloud.green = cloud.blue = np.arange(40, dtype=np.uint16) << 8
        found.append(made(lambda folder, cloud=cloud: cloud.write(str(folder / "input.las"))))
    return found
