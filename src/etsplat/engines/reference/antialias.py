"""Antialiased z-buffer rasterization in plain PyTorch: all pixels, and all pairs of pixels, at once."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.reference.rasterize import cross, to_screen


def antialias(
    vertices: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    near_plane: float,
    colors_of: str,
    connectivity: MeshConnectivity,
) -> Tensor:
    """Shade and blend what `rasterize_opaque` has seen: (B, H, W, C); colours of "faces", "vertices" or "pixels"."""
    faces, images = connectivity.faces.long(), []
    for b, (viewmat, K) in enumerate(zip(viewmats.detach(), Ks.detach(), strict=True)):
        screen, z = to_screen(vertices, viewmat, K)
        drawn = ((z > near_plane) & screen.isfinite().all(dim=1)).detach()
        row, column = (triangle[b] >= 0).nonzero(as_tuple=True)
        owner = triangle[b, row, column].long()
        if colors_of == "faces":
            values = colors[owner]
        elif colors_of == "pixels":
            values = colors[b, row, column]
        else:
            values = _interpolated(colors[faces[owner]], vertices[faces[owner]], viewmat, K, row, column)
        image = shaded = backgrounds[b].expand(*triangle[b].shape, -1).index_put((row, column), values)
        silhouette = _silhouettes(connectivity, screen.detach(), drawn)
        for axis in range(2):
            image = image + _blends(shaded, screen, silhouette, faces, triangle[b], depth[b], axis)
        images.append(image)
    return torch.stack(images) if images else vertices.new_zeros(*triangle.shape, colors.shape[-1])


def interpolate(
    vertices: Tensor,
    values: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
) -> Tensor:
    """Values of corners (F, 3, C) where `rasterize_opaque` has seen these: (B, H, W, C), 0 where there is nothing."""
    image = vertices.new_zeros(*triangle.shape, values.shape[-1])
    for b, (viewmat, K) in enumerate(zip(viewmats.detach(), Ks.detach(), strict=True)):
        row, column = (triangle[b] >= 0).nonzero(as_tuple=True)
        owner = triangle[b, row, column].long()
        found = _interpolated(values[owner], vertices[faces[owner].long()], viewmat, K, row, column)
        image = image.index_put((torch.full_like(row, b), row, column), found)
    return image


def texture_detail(
    vertices: Tensor,
    uvs: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    width: int,
    height: int,
) -> Float[Tensor, "B H W"]:
    """The level of detail that each pixel asks of a texture of so many texels, without gradients; 0 where nothing is.

    It is that at which a texel is as wide as the longer of the steps that texture coordinates make from a pixel to its
    neighbours (Williams 1983), and at least 0.
    """
    lod = vertices.new_zeros(triangle.shape)
    size = vertices.new_tensor([width, height])
    for b, (viewmat, K) in enumerate(zip(viewmats.detach(), Ks.detach(), strict=True)):
        row, column = (triangle[b] >= 0).nonzero(as_tuple=True)
        owner = triangle[b, row, column].long()
        corners = vertices.detach()[faces[owner].long()] @ viewmat[:3, :3].T + viewmat[:3, 3]
        # b = beta / sum(beta) with V beta = r, and the ray r = K^-1 (x, y, 1): beta moves by V^-1 K^-1 per pixel.
        turned = torch.linalg.solve(corners.mT, torch.linalg.inv(K)[:, :2].expand(len(owner), 3, 2))
        sums = turned.sum(dim=1, keepdim=True) * barycentrics[b, row, column][..., None]
        moved = depth[b, row, column][:, None, None] * (turned - sums)  # (pixels, 3, 2), by x and y
        steps = torch.einsum("nka,nkc->nac", moved, uvs.detach()[owner]) * size
        longest = steps.square().sum(dim=-1).amax(dim=-1)
        lod[b, row, column] = 0.5 * longest.clamp(1.0, 1e30).log2()
    return lod


def _interpolated(
    values: Tensor, corners: Tensor, viewmat: Tensor, K: Tensor, row: Tensor, column: Tensor
) -> Float[Tensor, "N C"]:
    """Values of corners (N, 3, C) where the rays of N pixels meet the triangles with these corners (N, 3, 3)."""
    corners = corners @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], dim=1).to(corners.dtype)
    rays = torch.linalg.solve(K, pixels.T).T
    # The point b_0 v_0 + b_1 v_1 + b_2 v_2 lies on the ray.
    beta = torch.linalg.solve(corners.mT, rays[..., None])[..., 0]
    return ((beta / beta.sum(dim=1, keepdim=True))[..., None] * values).sum(dim=1)


def _silhouettes(connectivity: MeshConnectivity, screen: Tensor, drawn: Tensor) -> Bool[Tensor, "F 3"]:
    """Whether the edge from corner k to k + 1 of each face has no drawn face on its other side."""
    faces = connectivity.faces.long()
    silhouette = torch.ones(faces.shape, dtype=torch.bool, device=faces.device)
    pairs = connectivity.face_pairs.long()
    for own, other in (pairs.unbind(1), pairs.flip(1).unbind(1)):
        usable = drawn[faces[other]].all(dim=1)
        for k in range(3):
            a, b, c = (faces[own, (k + i) % 3] for i in range(3))
            for j in range(3):
                p, q, opposite = (faces[other, (j + i) % 3] for i in range(3))
                shared = ((p == a) & (q == b)) | ((p == b) & (q == a))
                edge = screen[b] - screen[a]
                own_side, other_side = (cross(edge, screen[corner] - screen[a]) for corner in (c, opposite))
                across = own_side * other_side < 0
                silhouette[own[shared & usable & across], k] = False
    return silhouette


def _blends(
    shaded: Tensor, screen: Tensor, silhouette: Tensor, faces: Tensor, triangle: Tensor, depth: Tensor, axis: int
) -> Float[Tensor, "H W C"]:
    """What the pixels get through the silhouettes between horizontal (axis 0) or vertical (axis 1) neighbours."""
    height, width = triangle.shape
    size = (height, width - 1) if axis == 0 else (height - 1, width)
    y, x = (triangle[: size[0], : size[1]] != triangle[height - size[0] :, width - size[1] :]).nonzero(as_tuple=True)
    pixel = torch.stack([y * width + x, (y + axis) * width + x + 1 - axis])  # (2, pairs)
    owner, z = triangle.reshape(-1)[pixel].long(), depth.reshape(-1)[pixel]
    forward = (owner[1] < 0) | ((owner[0] >= 0) & (z[0] <= z[1]))
    nearer = torch.where(forward, owner[0], owner[1])
    result = torch.zeros_like(shaded).reshape(height * width, -1)
    for k in range(3):
        a, b = screen[faces[nearer, k]], screen[faces[nearer, (k + 1) % 3]]
        across = (y if axis == 0 else x) + 0.5
        crosses = (a[:, 1 - axis] <= across) != (b[:, 1 - axis] <= across)
        use = (silhouette[nearer, k] & crosses).nonzero()[:, 0]
        slope = (b[use, axis] - a[use, axis]) / (b[use, 1 - axis] - a[use, 1 - axis])
        position = a[use, axis] + (across[use] - a[use, 1 - axis]) * slope
        start = (x if axis == 0 else y)[use] + torch.where(forward[use], 0.5, 1.5)
        reach = torch.where(forward[use], position - start, start - position)
        keep = (slope.detach().abs() <= 1) & (reach.detach() >= 0) & (reach.detach() <= 1)
        use, reach = use[keep], reach[keep]
        overruns = reach.detach() > 0.5
        target = torch.where(overruns == forward[use], 1, 0)
        to, source = pixel[target, use], pixel[1 - target, use]
        flat = shaded.reshape(height * width, -1)
        result = result.index_add(0, to, (reach - 0.5).abs()[:, None] * (flat[source] - flat[to]))
    return result.reshape(shaded.shape)
