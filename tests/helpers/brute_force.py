"""A second oracle: one pixel and one triangle at a time, in Python floats, by other formulas than the engines.

Barycentrics come from a linear system, distances to edges from line equations, weights from a loop, the distortion from
the double sum over pairs. numpy float64 throughout; one view, one colour per triangle.
"""

from typing import Any

import numpy as np


def brute_force(scene: dict[str, Any], kernel: str, distance: str, depth: str, cutoffs: Any) -> dict[str, np.ndarray]:
    viewmat, K = scene["viewmats"][0].double().numpy(), scene["Ks"][0].double().numpy()
    world = scene["vertices"].double().numpy()
    in_view = world @ viewmat[:3, :3].T + viewmat[:3, 3]
    order = sorted(range(len(world)), key=lambda i: (in_view[i, :, 2].mean(), i))
    height, width = scene["height"], scene["width"]
    channels = scene["face_colors"].shape[1]
    images = {
        "color": np.zeros((height, width, channels)),
        "alpha": np.zeros((height, width, 1)),
        "depth": np.zeros((height, width, 1)),
        "median_depth": np.zeros((height, width, 1)),
        "normal": np.zeros((height, width, 3)),
        "distortion": np.zeros((height, width, 1)),
    }
    camera = np.linalg.inv(viewmat)[:3, 3]
    for row in range(height):
        for column in range(width):
            pixel = np.array([column + 0.5, row + 0.5])
            layers = _layers(pixel, order, in_view, K, scene, kernel, distance, depth, cutoffs)
            for name, value in _composite(layers, order, world, camera, scene).items():
                images[name][row, column] = value
    return images


def _layers(pixel, order, in_view, K, scene, kernel, distance, depth, cutoffs) -> list[tuple[int, float, float, float]]:
    """(triangle, weight, z, transmittance after) of each drawn triangle."""
    layers, T = [], 1.0
    sigma = scene["sigma"].double().expand(len(in_view)).numpy()
    for i in order:
        projected = (in_view[i] @ K.T)[:, :2] / in_view[i][:, 2:]
        a = np.linalg.solve(np.vstack([projected.T, np.ones(3)]), np.append(pixel, 1.0))
        x = 1 - 3 * a.min() if distance == "barycentric" else _sdf(pixel, projected)
        alpha = min(cutoffs.alpha_max, float(scene["opacities"][i]) * _kernel(kernel, x, sigma[i]))
        if alpha < cutoffs.alpha_min or x > cutoffs.x_max:
            continue
        if T * (1 - alpha) < cutoffs.transmittance_min:
            break
        clamped = np.maximum(a, 0) / np.maximum(a, 0).sum()
        z = 1 / (clamped / in_view[i][:, 2]).sum() if depth == "plane" else in_view[i][:, 2].mean()
        layers.append((i, alpha * T, z, T * (1 - alpha)))
        T *= 1 - alpha
    return layers


def _composite(layers, order, world, camera, scene) -> dict[str, Any]:
    T = layers[-1][3] if layers else 1.0
    color = T * scene["backgrounds"][0].double().numpy()
    depth = median = distortion = 0.0
    normal = np.zeros(3)
    previous = 1.0
    for i, weight, z, after in layers:
        color = color + weight * scene["face_colors"][i].double().numpy()
        depth += weight * z
        n = np.cross(world[i, 1] - world[i, 0], world[i, 2] - world[i, 0])
        n /= np.linalg.norm(n)
        normal += weight * (n if n @ (world[i].mean(axis=0) - camera) <= 0 else -n)
        median = z if previous > 0.5 >= after else median
        previous = after
    m = [100 / (100 - 0.2) * (1 - 0.2 / z) for _, _, z, _ in layers]
    for j in range(len(layers)):
        for k in range(j):
            distortion += layers[j][1] * layers[k][1] * (m[j] - m[k]) ** 2
    return {
        "color": color,
        "alpha": 1 - T,
        "depth": depth / max(1 - T, 1e-8),
        "median_depth": median,
        "normal": normal,
        "distortion": distortion,
    }


def _sdf(pixel, projected) -> float:
    """1 + signed distance / inradius, with the inradius as the distance from the incentre to an edge."""
    sides = np.array([np.linalg.norm(projected[(k + 1) % 3] - projected[(k + 2) % 3]) for k in range(3)])
    incentre = (sides[:, None] * projected).sum(axis=0) / sides.sum()

    def signed(point):
        distances = []
        for k in range(3):
            start, end, opposite = projected[(k + 1) % 3], projected[(k + 2) % 3], projected[k]
            normal = np.array([end[1] - start[1], start[0] - end[0]]) / np.linalg.norm(end - start)
            if normal @ (opposite - start) > 0:
                normal = -normal
            distances.append(normal @ (point - start))
        return max(distances)

    return 1 - signed(pixel) / signed(incentre)


def _kernel(kernel: str, x: float, sigma: float) -> float:
    if kernel == "single_sided":
        return max(1 - x, 0.0) ** sigma
    if kernel == "bilateral":
        return float(np.exp(-0.5 * x ** (2 / sigma)))
    if kernel == "elastic":
        return float(np.exp(-sigma * x ** (2 / sigma)))
    return float(x <= 1)
