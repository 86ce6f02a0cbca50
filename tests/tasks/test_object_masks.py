"""`etsplat data masks` on posed photos of a scene: by the surface where there is no plain background."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.demo_scene import demo_scene, demo_surface
from etsplat.io.images import save_image
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.tasks import object_masks
from etsplat.tasks.object_masks import mask_capture
from etsplat.tasks.train import train
from etsplat.tasks.train_config import TrainConfig
from helpers.captures import opengl_pose


@pytest.fixture(scope="module")
def things(tmp_path_factory):
    """The demo's scene as a folder, small; and where its photos show what is on the table."""
    folder, photos = tmp_path_factory.mktemp("things"), demo_scene(100, 75)
    vertices, _ = demo_surface()
    on_table = (vertices[..., 1].amax(dim=1) > 0.02) & (vertices.norm(dim=2).amax(dim=1) < 3)
    frames, truth = [], {}
    for index, name in enumerate(photos.names):
        path = folder / "images" / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        save_image(path, photos.images[index].float() / 255)
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": opengl_pose(photos.viewmats[index])})
        nearest = rasterize_opaque(vertices, cameras=photos.cameras[index]).triangle
        assert nearest is not None
        truth[name] = on_table[nearest[0].clamp_min(0).long()].numpy()
    K = photos.Ks[0]
    document = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    (folder / "transforms.json").write_text(json.dumps({**document, "w": 100, "h": 75, "frames": frames}))
    return folder, truth


def worst_iou(masks, truth):
    ious = []
    for name, shown in truth.items():
        mask = np.asarray(Image.open(masks / f"{name}.png")) >= 128
        ious.append((mask & shown).sum() / (mask | shown).sum())
    return min(ious)


def test_things_on_a_table_by_a_soup_that_is_fitted_on_the_way(things, tmp_path, monkeypatch):
    """Five of them; the photos' background is not plain, so that auto goes by the surface."""
    scene, truth = things
    monkeypatch.setattr(object_masks, "STEPS", 300)
    told = []
    masked = mask_capture(scene, tmp_path / "masks", progress=lambda *state: told.append(state))
    assert (masked.count, masked.by, masked.refused) == (len(truth), "surface", {})
    assert worst_iou(tmp_path / "masks", truth) > 0.8
    phases = list(dict.fromkeys(phase for phase, _, _ in told))
    assert phases == [  # the first by colours, in vain
        "Masking", "Reading the photos", "Fitting a coarse soup", "Looking for what stands on a surface"
    ]  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == ["masks"]  # nothing of the soup is left


def test_by_a_run_of_the_scene_and_none_of_another(things, tmp_path):
    """A soup without a surface is an error that leaves nothing behind."""
    scene, _ = things
    run = tmp_path / "run"
    train(scene, run, TrainConfig.tiny().changed({"iterations": 2, "width": 32}))
    other = tmp_path / "other"
    document = json.loads((scene / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 1.0
    shutil.copytree(scene / "images", other / "images")
    (other / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="is of another scene than"):
        mask_capture(other, tmp_path / "masks", soup=run)
    lone = TriangleSoup.from_triangles(torch.eye(3)[None], 0.5, opacity=0.5, sigma=1.0, sh_degree=0)
    lone.save(tmp_path / "lone.safetensors")
    with pytest.raises(InputError, match="masks: nothing was found that stands on a surface"):
        mask_capture(scene, tmp_path / "masks", soup=tmp_path / "lone.safetensors")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lone.safetensors", "other", "run"]
    assert mask_capture(scene, tmp_path / "masks", soup=run).by == "surface"


def test_by_the_background_alone_photos_of_a_scene_are_refused(things, tmp_path):
    scene, _ = things
    with pytest.raises(InputError, match="a plain background alone, which 42 of 42 photos lack"):
        mask_capture(scene, tmp_path / "masks", by="background")
    assert list(tmp_path.iterdir()) == []
