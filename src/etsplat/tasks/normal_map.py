"""Normals of a full mesh as a picture over a light one, for programs that light it.

Photos have the light of their place in their colours, so textured meshes are unlit. Who lights them anyway gets the
relief that decimation took: at each texel the normal of the nearest place on the full mesh, and its ambient occlusion.
"""

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.geometry.distance import closest_places, foot_weights
from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.occlusion import ambient_occlusion
from etsplat.geometry.tangents import corner_tangents
from etsplat.geometry.unwrap import texel_points
from etsplat.io.images import to_8_bit
from etsplat.io.mesh_files import MeshFile
from etsplat.io.textures import NormalMap
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.tasks.texturing import spread


@torch.no_grad()
def normal_map_of(mesh: TexturedMesh, full: MeshFile, *, occlusion: bool = False) -> NormalMap:
    """The normals of a full mesh in the tangent space of a light one, in a picture as large as its texture.

    Where the full mesh turns away from the light one, as beyond a thin wall, the light one's own normal stays.

    Args:
        mesh: the light mesh, in the frame of the full one.
        full: closed, or nearly so; its normals are smooth over its faces.
        occlusion: whether the picture of its ambient occlusion, of half as many texels along each side, is made too.
    """
    vertices, faces = mesh.surface()
    normals, size = _normals(vertices, faces), len(mesh.texture)
    tangents = corner_tangents(vertices, faces, normals, mesh.face_uvs)
    covered, points, face = texel_points(vertices, faces, mesh.face_uvs.cpu(), size)
    weights = foot_weights(points, vertices[faces[face].long()]).clamp_min(0)[..., None].float()
    normal = normalize((weights * normals[faces[face].long()]).sum(dim=1), dim=1)
    tangent = normalize((weights * tangents[face][..., :3]).sum(dim=1), dim=1)
    bitangent = tangents[face][:, 0, 3:] * torch.linalg.cross(normal, tangent)
    _, wanted = _nearest(full, points)
    wanted = torch.where((wanted * normal).sum(dim=1, keepdim=True) > 0, wanted, normal)
    axes = torch.stack([tangent, bitangent, normal], dim=-1)
    found = normalize(torch.linalg.lstsq(axes.double(), wanted.double()[..., None]).solution[..., 0], dim=1)
    picture = torch.zeros(size, size, 3)
    picture[covered] = 0.5 + 0.5 * found.float()
    shade = _occlusion(mesh, full, normals, max(1, size // 2)) if occlusion else None
    return NormalMap(to_8_bit(spread(picture, covered)), normals[faces.long()], tangents, shade)


def _occlusion(
    mesh: TexturedMesh, full: MeshFile, normals: Float[Tensor, "V 3"], size: int
) -> UInt8[Tensor, "size size"]:
    """Where the light mesh has texels, the ambient occlusion of the nearest places on the full one."""
    vertices, faces = mesh.surface()
    covered, points, face = texel_points(vertices, faces, mesh.face_uvs.cpu(), size)
    places, outwards = _nearest(full, points)
    alike = (outwards * normals[faces[face].long()].sum(dim=1)).sum(dim=1) > 0
    known, picture = covered.clone(), torch.ones(size, size, 1)
    known[covered] = alike
    picture[known] = ambient_occlusion(full.vertices, full.faces, places[alike], outwards[alike])[:, None]
    return to_8_bit(spread(picture, known) if bool(known.any()) else picture)[..., 0]


def _nearest(full: MeshFile, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """(N, 3) the places of a mesh that are nearest to points, and (N, 3) its unit normals there."""
    face, weights = closest_places(points, full.vertices, full.faces)
    normals, corners = _normals(full.vertices, full.faces)[full.faces[face]], full.vertices[full.faces[face]]
    weights = weights[..., None].float()
    return (weights * corners).sum(dim=1), normalize((weights * normals).sum(dim=1), dim=1)


def _normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """(V, 3) unit normals of vertices; +z where there is none, as files must have one."""
    found = vertex_normals(vertices, faces)
    return torch.where(found.square().sum(dim=1, keepdim=True) > 0.5, found, found.new_tensor([0.0, 0.0, 1.0]))
