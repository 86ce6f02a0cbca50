"""Pictures that a mesh file lays over its faces, and the colours that they give to points of these."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor


@dataclass(frozen=True)
class Texture:
    """Colours of a mesh that vary within its faces. A material without a picture has one of a single pixel.

    Attributes:
        pixels: (P, 3) of all pictures one after the other, display values (sRGB), row by row from the top.
        sizes: (I, 2) height and width of each picture.
        face_images: (F,) the picture of each face.
        corner_uvs: (F, 3, 2) where the corners of each face are in it: (0, 0) is its lower left corner, (1, 1) the
            upper right one; beyond these it repeats.
    """

    pixels: UInt8[Tensor, "P 3"]
    sizes: Int64[Tensor, "I 2"]
    face_images: Int64[Tensor, " F"]
    corner_uvs: Float[Tensor, "F 3 2"]

    @classmethod
    def of(
        cls,
        images: Sequence[UInt8[Tensor, "H W 3"]],
        face_images: Int64[Tensor, " F"],
        corner_uvs: Float[Tensor, "F 3 2"],
    ) -> "Texture":
        """Of whole pictures, each (H, W, 3)."""
        sizes = torch.tensor([image.shape[:2] for image in images])
        return cls(torch.cat([image.reshape(-1, 3) for image in images]), sizes, face_images, corner_uvs)

    def keep(self, faces: Tensor) -> "Texture":
        """That of some of the faces, by index or mask."""
        return replace(self, face_images=self.face_images[faces], corner_uvs=self.corner_uvs[faces])

    def picture(self) -> UInt8[Tensor, "H W 3"] | None:
        """The one that all faces are under; None where these are under several."""
        used = self.face_images.unique()
        if len(used) != 1:
            return None
        number = int(used)
        height, width = self.sizes[number].tolist()
        first = int(self.sizes[:number].prod(dim=1).sum())
        return self.pixels[first : first + height * width].reshape(height, width, 3)

    def to(self, device: torch.device | str) -> "Texture":
        """The same on a device."""
        return Texture(**{name: tensor.to(device) for name, tensor in vars(self).items()})

    def colors(self, faces: Int64[Tensor, " N"], weights: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The colours of points of faces in [0, 1], bilinear between the pixels' centres.

        Args:
            faces: the face of each point.
            weights: its barycentric coordinates.
        """
        uv = torch.einsum("nk,nkc->nc", weights, self.corner_uvs[faces])
        uv = uv - uv.floor()
        areas, image = self.sizes.prod(dim=1), self.face_images[faces]
        first, (height, width) = (areas.cumsum(0) - areas)[image], self.sizes[image].unbind(1)
        x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
        left, top = x.floor(), y.floor()
        columns = [(left.long() + step) % width for step in (0, 1)]
        rows = []
        for step in (0, 1):
            row = first + (top.long() + step) % height * width
            west, east = (self.pixels[row + column].float() for column in columns)
            rows.append(torch.lerp(west, east, (x - left)[:, None]))
        north, south = rows
        return torch.lerp(north, south, (y - top)[:, None]) / 255


@dataclass(frozen=True)
class NormalMap:
    """How light falls on the faces under a texture: what lies beside its picture in a file.

    Attributes:
        pixels: (H, W, 3) normals in tangent space, -1 to 1 as 0 to 255, row by row from the top, where the texture is.
        normals: (F, 3, 3) unit normals of the corners.
        tangents: (F, 3, 4) their tangents and signs, as of `etsplat.geometry.tangents`.
        occlusion: (H, W) how much of the light from all around comes to each texel, 0 to 1 as 0 to 255; or None.
    """

    pixels: UInt8[Tensor, "H W 3"]
    normals: Float[Tensor, "F 3 3"]
    tangents: Float[Tensor, "F 3 4"]
    occlusion: UInt8[Tensor, "H W"] | None = None

    def turned(self, rotation: Float[Tensor, "3 3"]) -> "NormalMap":
        """The same over faces that were turned."""
        back = rotation.to(self.normals).T
        tangents = torch.cat([self.tangents[..., :3] @ back, self.tangents[..., 3:]], dim=-1)
        return replace(self, normals=self.normals @ back, tangents=tangents)
