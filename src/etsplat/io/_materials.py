"""Textures that mesh files name: MTL beside OBJ, materials of glTF. What is left out has a note that says why."""

import base64
from collections.abc import Callable
from pathlib import Path, PureWindowsPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from etsplat.core.errors import InputError
from etsplat.io._gltf import fractions, local_file, view_bytes
from etsplat.io.images import IMAGE_FORMATS, MAX_PIXELS, load_colors
from etsplat.io.ply_tables import PLACES, read_ply_tables
from etsplat.io.srgb import linear_from_srgb, srgb_from_linear
from etsplat.io.textures import Texture

UV = "_ETSPLAT_MATERIAL_"
"""Beginning of an attribute of glTF vertices: the number of the material follows, its values are where they are."""

GLTF_FORMATS = (*IMAGE_FORMATS, "WEBP")
"""Pillow's names of what pictures may be."""

_TRANSFORM, _OLDER = "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness"

_OPTIONS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}
"""Numbers that follow an option of a picture in an MTL file, at most; others are followed by one word."""


class Pictures:
    """The pictures of a mesh's materials, each read once.

    Attributes:
        notes: what was left out.
        textured: whether there is a picture that is more than a colour.
    """

    def __init__(self) -> None:
        self._images: list[np.ndarray] = []
        self._numbers: dict[object, int] = {}
        self._pixels = 0
        self.notes: list[str] = []
        self.textured = False

    def note(self, text: str) -> None:
        """Says something once."""
        if text not in self.notes:
            self.notes.append(text)

    def plain(self, color: np.ndarray) -> int:
        """The number of a picture of one pixel, of display values in [0, 1]."""
        pixel = np.rint(255 * np.clip(np.nan_to_num(color), 0, 1)).astype(np.uint8).reshape(1, 1, 3)
        return self._number(pixel.tobytes(), lambda: pixel)

    def read(self, key: object, find: Callable[[], tuple[Path, bytes | None]], tint: np.ndarray, color: int) -> int:
        """The number of a picture, or `color` where it cannot be used.

        Args:
            key: of the picture with its tint.
            find: its file, and its content where it is within that file.
            tint: what multiplies its linear light.
            color: the number to take instead.

        Raises:
            InputError: it is no picture's fault: all of them together are too large.
        """

        def load() -> np.ndarray:
            path, data = find()
            image, transparent = load_colors(path, data, GLTF_FORMATS)
            if transparent:
                self.note(f"{path.name}: its transparency is ignored")
            if not np.array_equal(tint, np.ones(3)):
                curve = srgb_from_linear(linear_from_srgb(np.arange(256) / 255)[:, None] * tint).clip(0, 1)
                image = np.stack(
                    [np.rint(255 * curve[:, c]).astype(np.uint8)[image[..., c]] for c in range(3)], axis=-1
                )
            return image

        try:
            number = self._number(key, load)
        except InputError as error:
            self.note(f"a texture is left out: {error}")
            return color
        self.textured = True
        return number

    def texture(self, face_images: np.ndarray, corner_uvs: np.ndarray) -> Texture | None:
        """That of the faces, if any picture could be used."""
        if not self.textured:
            return None
        images = [torch.from_numpy(image) for image in self._images]
        return Texture.of(
            images, torch.from_numpy(face_images.astype(np.int64)), torch.from_numpy(corner_uvs.astype(np.float32))
        )

    def colors(self, face_images: np.ndarray) -> np.ndarray | None:
        """(F, 3) the plain colours of faces in [0, 1], where no picture could be used; None of one grey for all."""
        if self.textured or not len(face_images):
            return None
        colors = np.concatenate(self._images)[face_images, 0]
        plain = (colors == colors[0, 0]).all()
        return None if plain else colors / 255

    def _number(self, key: object, load: Callable[[], np.ndarray]) -> int:
        if key not in self._numbers:
            image = load()
            self._pixels += image.shape[0] * image.shape[1]
            if self._pixels > MAX_PIXELS:
                raise InputError(f"textures: more than {MAX_PIXELS // 10**6} million pixels together; shrink them")
            self._numbers[key] = len(self._images)
            self._images.append(image)
        return self._numbers[key]


def read_mtl(path: Path) -> tuple[dict[str, dict[str, str]], list[str]]:
    """The statements of each material by name: colour `Kd`, picture `map_Kd`; and notes on what is ignored."""
    materials: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    ignored: set[str] = set()
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            key, rest = (*line.strip().split(None, 1), "", "")[:2]
            if key == "newmtl":
                current = materials.setdefault(rest, {})
            elif key in ("Kd", "map_Kd"):
                current[key] = rest
            elif key.lower().startswith(("map_", "bump", "norm", "disp", "decal", "refl")):
                ignored.add(key)
    return materials, [f"{path.name}: {', '.join(sorted(ignored))} ignored; only map_Kd is seen"] if ignored else []


def ply_texture(path: Path, names: list[str], faces: int) -> tuple[Texture | None, list[str]]:
    """The texture of a PLY, and notes.

    Args:
        path: of the file.
        names: of the pictures that its comments name.
        faces: how many it has.
    """
    pictures = Pictures()
    try:
        if len(names) > 1:
            raise InputError(f"{len(names)} pictures, and one is read from PLY; save it as glb")
        table = read_ply_tables(path, ("face",))["face"]
        if PLACES not in (table.dtype.names or ()) or len(table) != faces:
            raise InputError(f"{path.name} has no list {PLACES} at faces; save it as glb")
        places = table[PLACES].reshape(-1, 3, 2).astype(np.float64)
        if not (np.abs(places) < np.finfo(np.float32).max).all():
            raise InputError("texture coordinates that are not finite; export it again")
    except InputError as error:
        return None, [f"its texture is left out: {error}"]
    number = pictures.read(names[0], lambda: (local_file(path.parent, names[0], path), None), np.ones(3), 0)
    return pictures.texture(np.full(faces, number), places), pictures.notes


def obj_texture(
    path: Path,
    libraries: list[str],
    names: list[str],
    face_materials: np.ndarray,
    uvs: np.ndarray,
    face_uvs: np.ndarray,
) -> tuple[Texture | None, np.ndarray | None, list[str]]:
    """The texture of an OBJ, or the plain colours of its faces where it has none, and notes.

    Args:
        path: of the OBJ.
        libraries: MTL files that it names.
        names: of materials.
        face_materials: (F,) numbers of these.
        uvs: (T, 2) texture coordinates.
        face_uvs: (F, 3) numbers of these, negative where a corner has none.
    """
    pictures, materials = Pictures(), {}
    for library in libraries:
        try:
            file = local_file(path.parent, library, path)
            if not file.is_file():
                raise InputError(f"{file}: no such file")
            found, notes = read_mtl(file)
        except InputError as error:
            pictures.note(f"materials are left out: {error}")
            continue
        materials |= {name: (file, statements) for name, statements in found.items()}
        for note in notes:
            pictures.note(note)
    unknown = [name for name in names if name and name not in materials]
    if unknown and materials:  # without any it was said already
        pictures.note(f"faces of materials that no MTL file has are white: {', '.join(map(repr, unknown[:3]))}")
    numbers, plain = [], []
    for name in names:
        file, statements = materials.get(name, (path, {}))
        color = pictures.plain(_numbers(statements.get("Kd", "1 1 1")))
        plain.append(color)
        if "map_Kd" in statements:
            image, options = _picture_name(statements["map_Kd"])
            if PureWindowsPath(image).root and (file.parent / PureWindowsPath(image).name).is_file():
                image = PureWindowsPath(image).name  # the path is of another computer, and the picture is here
            if options:
                pictures.note(f"{file.name}: options {', '.join(options)} of map_Kd are ignored")
            key = file.parent, image
            color = pictures.read(key, lambda f=file, i=image: (local_file(f.parent, i, f), None), np.ones(3), color)
        numbers.append(color)
    placed = (face_uvs >= 0).all(axis=1)
    wanted, plainly = (np.array(each)[face_materials] for each in (numbers, plain))
    missing = int(np.count_nonzero((wanted != plainly) & ~placed))
    if missing:
        pictures.note(f"{missing} faces have no coordinates for their texture, but its material's plain colour")
    corners = np.zeros((len(face_uvs), 3, 2))
    corners[placed] = uvs[face_uvs[placed]]
    return pictures.texture(np.where(placed, wanted, plainly), corners), pictures.colors(plainly), pictures.notes


def _numbers(text: str) -> np.ndarray:
    try:
        values = [float(word) for word in text.split()[:3]]
    except ValueError:  # a spectrum or xyz
        values = []
    return np.array(values) if len(values) == 3 else np.ones(3)


def _picture_name(text: str) -> tuple[str, list[str]]:
    """A picture's file, which may have blanks in its name, and the options before it."""
    words, options = text.split(" "), []
    while words[0].startswith("-") and len(words) > 1:
        option = words.pop(0)
        options.append(option)
        for _ in range(_OPTIONS.get(option, 1)):
            if len(words) > 1 and (option not in _OPTIONS or words[0].lstrip("+-").replace(".", "", 1).isdigit()):
                words.pop(0)
    return " ".join(words), options


class GltfMaterials:
    """The materials of a glTF document whose base colours are pictures, or other than white."""

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes) -> None:
        self._path, self._document, self._binary = path, document, binary
        self.pictures = Pictures()
        self._numbers: dict[int, int] = {}

    @property
    def wanted(self) -> bool:
        """Whether any material has a picture, or a colour for its base."""
        materials = self._document.get("materials", [])
        bases = [_base(material) for material in materials]
        colored = any("baseColorTexture" in base or bool((_factor(base) != 1).any()) for base in bases)
        return colored or any(_unseen(material) for material in materials)

    def mark(self) -> None:
        """Gives the vertices of each primitive an attribute that says its material and where they are in its picture.

        Readers keep attributes of other names than their own, whatever they do with primitives.
        """
        materials = self._document["materials"]
        for primitive in (each for mesh in self._document.get("meshes", []) for each in mesh["primitives"]):
            attributes, number = primitive["attributes"], primitive.get("material")
            if number is None:
                number = -1
            elif not 0 <= number < len(materials):
                raise ValueError(f"material {number} of {len(materials)}")
            base = _base(materials[number]).get("baseColorTexture", {}) if number >= 0 else {}
            place = _transform(base).get("texCoord", base.get("texCoord", 0))
            uv = attributes.get(f"TEXCOORD_{place}") if base else None
            attributes[f"{UV}{number}"] = attributes["POSITION"] if uv is None else uv
            if base and uv is None:
                self.pictures.note(f"{self._path.name}: a primitive has no coordinates for its texture")
            if base and "COLOR_0" in attributes:
                self.pictures.note(f"{self._path.name}: colours of vertices under a texture are ignored")

    def factor(self, attributes: dict[str, np.ndarray]) -> np.ndarray:
        """(3,) what multiplies the linear light of a primitive's vertices."""
        _, number = _marked(attributes)
        return _factor(_base(self._document["materials"][number])) if number >= 0 else np.ones(3)

    def uvs(self, attributes: dict[str, np.ndarray]) -> tuple[int, np.ndarray]:
        """The number of a primitive's picture, and (V, 2) where its vertices are in that."""
        name, number = _marked(attributes)
        values = fractions(np.asarray(attributes[name]))
        base = _base(self._document["materials"][number]) if number >= 0 else {}
        uvs = _transformed(values[:, :2], _transform(base.get("baseColorTexture", {})))
        uvs[:, 1] = 1 - uvs[:, 1]  # glTF counts from the top
        if "baseColorTexture" in base and bool(((uvs < 0) | (uvs > 1)).any()):
            self._check_wrap(self._document["textures"][base["baseColorTexture"]["index"]])
        if number not in self._numbers:
            self._numbers[number] = self._picture(number)
        return self._numbers[number], uvs

    def _picture(self, number: int) -> int:
        material = self._document["materials"][number] if number >= 0 else {}
        base = _base(material)
        tint = _factor(base)
        color = self.pictures.plain(srgb_from_linear(tint))
        if used := _unseen(material):
            self.pictures.note(f"{self._path.name}: {', '.join(sorted(used))} ignored; only baseColorTexture is seen")
        if "baseColorTexture" not in base:
            return color
        if unknown := sorted(set(base["baseColorTexture"].get("extensions", {})) - {_TRANSFORM}):
            self.pictures.note(f"{self._path.name}: {', '.join(unknown)} of baseColorTexture is ignored")
        texture = self._document["textures"][base["baseColorTexture"]["index"]]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        return self.pictures.read((source, *tint), lambda: self._image(source), tint, color)

    def _check_wrap(self, texture: dict[str, Any]) -> None:
        sampler = self._document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        if {sampler.get("wrapS", 10497), sampler.get("wrapT", 10497)} != {10497}:
            self.pictures.note(f"{self._path.name}: a texture repeats here that is clamped or mirrored at its border")

    def _image(self, number: int | None) -> tuple[Path, bytes | None]:
        if number is None:  # an extension has it: KTX2
            raise InputError(f"{self._path}: a texture that is no PNG, JPEG or WebP; convert it")
        image = self._document["images"][number]
        if "bufferView" in image:
            view = self._document["bufferViews"][image["bufferView"]]
            return self._path, view_bytes(self._path, self._document, self._binary, view)
        uri = image["uri"]
        if uri.startswith("data:"):
            return self._path, base64.b64decode(uri.partition(",")[2])
        return local_file(self._path.parent, unquote(uri), self._path), None


def _base(material: dict[str, Any]) -> dict[str, Any]:
    """What is said of a material's own colour; an older model of materials, which goes first, calls that diffuse."""
    if (older := material.get("extensions", {}).get(_OLDER)) is None:
        return material.get("pbrMetallicRoughness", {})
    names = {"diffuseTexture": "baseColorTexture", "diffuseFactor": "baseColorFactor"}
    return {ours: older[name] for name, ours in names.items() if name in older}


def _unseen(material: dict[str, Any]) -> set[str]:
    """The maps of a material that are ignored, by name."""
    used = {"normalTexture", "occlusionTexture", "emissiveTexture"} & set(material)
    used |= {"metallicRoughnessTexture"} & set(material.get("pbrMetallicRoughness", {}))
    return used | {"specularGlossinessTexture"} & set(material.get("extensions", {}).get(_OLDER, {}))


def _transform(info: dict[str, Any]) -> dict[str, Any]:
    """How texture coordinates are to be transformed for a picture; empty if they are not."""
    return info.get("extensions", {}).get(_TRANSFORM, {})


def _transformed(uvs: np.ndarray, transform: dict[str, Any]) -> np.ndarray:
    """(V, 2) texture coordinates, v downwards: scaled, turned counterclockwise as the picture is seen, then moved."""
    if not transform:
        return uvs
    (x, y), (width, height) = transform.get("offset", (0, 0)), transform.get("scale", (1, 1))
    cos, sin = np.cos(transform.get("rotation", 0)), np.sin(transform.get("rotation", 0))
    return uvs * (width, height) @ np.array([[cos, -sin], [sin, cos]]) + (x, y)


def _factor(base: dict[str, Any]) -> np.ndarray:
    """(3,) linear light that multiplies a picture, or is there without one."""
    return np.array(base.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])[:3], dtype=np.float64)


def _marked(attributes: dict[str, np.ndarray]) -> tuple[str, int]:
    """The attribute that `GltfMaterials.mark` gave a primitive, and the number of its material, -1 for none."""
    name = next(name for name in attributes if name.startswith(UV))
    return name, int(name[len(UV) :])
