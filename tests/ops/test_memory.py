"""Operations read their arguments where these are at that moment, and the values that they stand for.

Between forward and backward autograd may hand over other memory with the same values and free the first: checkpointing
and hooks on saved tensors do.
"""

import math
from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from etsplat import MeshTopology, intrinsics, look_at, rasterize, rasterize_antialiased, rasterize_opaque
from etsplat.core.cameras import MAX_SIDE, Cameras
from etsplat.engines.native.pool import empty_image
from etsplat.ops.adam import Adam
from etsplat.ops.rasterize_opaque import render_opaque
from helpers.engines import device_of, looking, on
from helpers.operations import CASES, Case, Run, loss
from helpers.scenes import mesh, soup


@pytest.fixture(params=["cpu", "cuda"])
def native(request: pytest.FixtureRequest) -> str:
    """Native engines; kernels of "cuda" run on CPU tensors, whose memory the tests can spoil."""
    if request.param == "cuda":
        request.getfixturevalue("simt")
    return request.param


def _gradients(case: Case, loss: Callable[..., Tensor], runs: int = 1) -> dict[str, Tensor]:
    leaves = {name: value.detach().clone().requires_grad_() for name, value in case[0].items()}
    total = loss(leaves)
    for _ in range(runs):
        total.backward(retain_graph=runs > 1)
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _plainly(run: Run, leaves: dict[str, Tensor]) -> Tensor:
    # What the operation gets is freed as soon as autograd does not need it.
    return loss(run(**{name: leaf * 1.0 for name, leaf in leaves.items()}))


def _same(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float = 0.0) -> None:
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        assert gradient.abs().sum() > 0, name
        limit = tolerance * float(gradient.abs().max())
        torch.testing.assert_close(found[name], gradient, rtol=0, atol=limit, msg=name)


def _spoil_free_memory() -> list[Tensor]:
    """Fills what has been freed, in torch's allocator and in the pool, with NaN."""
    sizes = [*range(4, 400, 4), *(3 * 40 * 48 * k for k in range(1, 24))]
    blocks = [torch.full((size,), math.nan) for size in sizes for _ in range(4)]
    return blocks + [empty_image(1 << 17).fill_(math.nan) for _ in range(4)]


def _cloned_and_freed(saved: Tensor) -> Tensor:
    """Packs a copy that lies elsewhere; unpacking it copies again, and the copy that was unpacked is spoilt later."""
    return saved.detach().clone()


@pytest.mark.sanitize
@pytest.mark.parametrize("name", CASES)
class TestSavedTensors:
    @pytest.mark.parametrize("reentrant", [True, False])
    def test_checkpoint_gives_the_same_gradients(self, name, reentrant, native, rng):
        case = CASES[name](rng, native)
        expected = _gradients(case, partial(_plainly, case[1]))

        def loss(leaves: dict[str, Tensor]) -> Tensor:
            def run(*values: Tensor) -> Tensor:
                return _plainly(case[1], dict(zip(leaves, values, strict=True)))

            value = checkpoint(run, *leaves.values(), use_reentrant=reentrant)
            spoilt = _spoil_free_memory()
            assert len(spoilt) > 0
            return value

        _same(_gradients(case, loss), expected)

    def test_hooks_that_move_what_is_saved_give_the_same_gradients(self, name, native, rng):
        case = CASES[name](rng, native)
        expected = _gradients(case, partial(_plainly, case[1]))
        unpacked = []

        def unpack(packed: Tensor) -> Tensor:
            # Other strides, too, where there is more than one dimension.
            unpacked.append(
                packed.transpose(0, -1).contiguous().transpose(0, -1) if packed.ndim > 1 else packed.clone()
            )
            return unpacked[-1]

        def loss(leaves: dict[str, Tensor]) -> Tensor:
            with torch.autograd.graph.saved_tensors_hooks(_cloned_and_freed, unpack):
                value = _plainly(case[1], leaves)
            spoilt = _spoil_free_memory()
            assert len(spoilt) > 0
            return value

        _same(_gradients(case, loss), expected, tolerance=1e-5)  # torch itself adds in another order for other strides
        assert unpacked

    def test_unpacked_tensors_may_be_freed_when_backward_has_dropped_them(self, name, native, rng):
        case = CASES[name](rng, native)
        expected = _gradients(case, partial(_plainly, case[1]))

        def unpack(packed: Tensor) -> Tensor:
            _spoil_free_memory()  # what an earlier unpacking has left
            return packed.clone()

        def loss(leaves: dict[str, Tensor]) -> Tensor:
            with torch.autograd.graph.saved_tensors_hooks(_cloned_and_freed, unpack):
                return _plainly(case[1], leaves)

        _same(_gradients(case, loss), expected)

    def test_a_second_backward_adds_the_same_again(self, name, native, rng):
        case = CASES[name](rng, native)
        expected = _gradients(case, partial(_plainly, case[1]))
        twice = _gradients(case, partial(_plainly, case[1]), runs=2)
        _same(twice, {name: 2 * gradient for name, gradient in expected.items()})


@pytest.mark.sanitize
@pytest.mark.parametrize("name", CASES)
class TestOddTensors:
    def test_a_sign_that_is_not_in_memory_counts(self, name, native, rng):
        leaves, run = CASES[name](rng, native)
        expected = run(**leaves)
        for key, value in leaves.items():
            odd = torch._neg_view(-value)
            assert odd.is_neg()
            for found, wanted in zip(run(**{**leaves, key: odd}), expected, strict=True):
                torch.testing.assert_close(found, wanted, rtol=0, atol=0, msg=key)

    def test_a_gradient_with_such_a_sign_counts(self, name, native, rng):
        leaves, run = CASES[name](rng, native)
        grown = {key: value.clone().requires_grad_() for key, value in leaves.items()}
        outputs = [output for output in run(**grown) if output.requires_grad]
        cotangents = [torch.rand(output.shape, generator=rng) for output in outputs]
        odd = [torch._neg_view(-cotangent) for cotangent in cotangents]
        found, expected = (
            torch.autograd.grad(outputs, list(grown.values()), chosen, retain_graph=True, allow_unused=True)
            for chosen in (odd, cotangents)
        )
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)

    def test_tensors_without_memory_are_refused_by_name(self, name, native, rng):
        leaves, run = CASES[name](rng, native)
        for key, value in leaves.items():
            freed = value.clone()
            freed.untyped_storage().resize_(0)
            for odd in (freed, torch._efficientzerotensor(value.shape), value.reshape(1, -1).to_sparse()):
                with pytest.raises(ValueError, match=r"must (have memory of its own|be a dense tensor|have shape)"):
                    run(**{**leaves, key: odd})


FACES = torch.arange(300).view(100, 3)


def _draw(faces: Tensor, engine: str, **options) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    vertices = torch.randn(300, 3, generator=generator) * 0.5
    colors, opacities = torch.rand(100, 3, generator=generator), torch.ones(100)
    view = look_at(torch.tensor([[0.0, 0.0, 4.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    size = (intrinsics(50, 40, 30)[None], 40, 30)
    n = len(faces)
    colored = {"face_colors": colors[:n], "opacities": opacities[:n], "sigma": 0.1}
    return on(engine, rasterize, vertices, **colored, cameras=Cameras(view, *size), faces=faces, **options).color


@pytest.mark.sanitize
class TestFaces:
    @pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
    def test_faces_changed_through_numpy_are_drawn(self, native, dtype):
        faces = FACES.to(dtype)
        before = _draw(faces, native)
        faces.numpy()[:] = faces.roll(1).flip(0).numpy()
        after = _draw(faces, native)
        assert torch.equal(after, _draw(faces.clone(), native))
        assert not torch.equal(after, before)

    @pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
    def test_other_faces_in_the_same_tensor_are_drawn(self, native, dtype):
        faces = torch.nn.Parameter(FACES[:10].to(dtype), requires_grad=False)
        _draw(faces, native)
        faces.data = FACES.to(dtype)
        assert torch.equal(_draw(faces, native), _draw(FACES, native))

    def test_faces_changed_between_forward_and_backward_do_not_matter(self, native, rng):
        scene = mesh(rng)
        scene["faces"] = scene["faces"].to(torch.int32)
        arguments = {key: value for key, value in scene.items() if key != "vertices"}

        def gradient(spoil: bool) -> Tensor:
            faces, vertices = arguments["faces"].clone(), scene["vertices"].clone().requires_grad_()
            color = on(native, rasterize, vertices, **{**arguments, "faces": faces}).color
            if spoil:
                faces.data.fill_(2**31 - 1)
            color.square().sum().backward()
            assert vertices.grad is not None
            return vertices.grad

        assert torch.equal(gradient(True), gradient(False))

    def test_wrong_faces_put_there_after_a_call_are_refused(self):
        faces = FACES.to(torch.int32)
        _draw(faces, "cpu")
        faces.numpy()[0, 0] = 10**8
        with pytest.raises(ValueError, match="faces must be indices from 0 to 299"):
            _draw(faces, "cpu")

    def test_faces_made_in_inference_mode_are_drawn(self, native):
        expected = _draw(FACES, native)
        with torch.inference_mode():
            assert torch.equal(_draw(FACES.clone(), native), expected)


@pytest.mark.sanitize
class TestOddArguments:
    def test_opaque_pictures_count_signs_and_refuse_freed_memory(self, engine, rng):
        scene = mesh(rng)
        dtype = torch.float64 if engine == "reference" else torch.float32
        device = device_of(engine)
        points, *view = (scene[key].to(device, dtype) for key in ("vertices", "viewmats", "Ks"))
        options = {"faces": scene["faces"]}
        size, colors = (scene["width"], scene["height"]), scene["face_colors"].to(dtype)
        for draw in (
            lambda points, *view: on(engine, rasterize_opaque, points, cameras=Cameras(*view, *size), **options).depth,
            lambda points, *view: (
                on(engine, render_opaque, points, cameras=Cameras(*view, *size), face_colors=colors, **options).rgba
            ),
        ):
            expected = draw(points, *view)
            assert torch.equal(draw(torch._neg_view(-points), *view), expected)
            freed = points.clone()
            freed.untyped_storage().resize_(0)
            with pytest.raises(ValueError, match="vertices must have memory of its own"):
                draw(freed, *view)

    def test_faces_without_memory_are_refused(self):
        faces = FACES.clone()
        faces.untyped_storage().resize_(8)
        with pytest.raises(ValueError, match="faces must have memory of its own: it needs 2400 bytes"):
            _draw(faces, "cpu")

    def test_adam_counts_signs_and_refuses_a_parameter_of_another_shape(self):
        found = []
        for odd in (False, True):
            value, gradient = torch.rand(5), torch.linspace(-1, 1, 5)
            value = value.zero_().requires_grad_()
            value.grad = torch._neg_view(-gradient) if odd else gradient
            optimizer = Adam({"value": value}, {"value": 0.1})
            optimizer.step()
            found.append(value.detach())
        assert torch.equal(*found)
        value.data, value.grad = torch.zeros(7), None
        value.grad = torch.zeros(7)
        with pytest.raises(ValueError, match="parameter value, its gradient and moments must have one shape"):
            optimizer.step()

    @pytest.mark.parametrize("name", ["opacities", "sigma"])
    def test_what_is_no_option_cannot_be_none(self, name, rng):
        with pytest.raises(ValueError, match=f"{name} must be a tensor of shape .*, got NoneType"):
            rasterize(**{**soup(rng, 20), name: None})

    def test_flags_that_are_no_bool_are_refused(self, rng):
        scene = mesh(rng)
        with pytest.raises(ValueError, match="freeze_inradius must be True or False, got 2"):
            rasterize(**scene, freeze_inradius=2)
        shown = {key: scene[key] for key in ("vertices", "faces", "viewmats", "Ks", "width", "height", "face_colors")}
        with pytest.raises(ValueError, match="cull_backfaces must be True or False, got None"):
            render_opaque(**shown, cull_backfaces=None)

    @pytest.mark.parametrize("size", [MAX_SIDE + 1, 2**31, 2**40])
    @pytest.mark.parametrize("name", ["width", "height"])
    def test_sizes_beyond_what_can_be_numbered_are_refused(self, name, size, rng):
        scene = {**mesh(rng), name: size}
        opaque = {key: scene[key] for key in ("vertices", "faces", "viewmats", "Ks", "width", "height")}
        topology = MeshTopology.from_faces(scene["faces"], len(scene["vertices"]))
        antialiased = {key: value for key, value in opaque.items() if key != "faces"}
        colors = {"face_colors": torch.rand(len(scene["faces"]), 3)}
        for draw in (
            partial(rasterize, **scene),
            partial(rasterize_opaque, **opaque),
            partial(render_opaque, **opaque, **colors),
            partial(rasterize_antialiased, **antialiased, **colors, connectivity=topology.connectivity),
        ):
            with pytest.raises(ValueError, match=rf"{name}.* must be .* {MAX_SIDE}, got"):
                draw()

    @pytest.mark.parametrize("name", ["face_colors", "backgrounds"])
    def test_colours_whose_gradients_would_overflow_are_refused(self, engine, name, rng):
        scene = soup(rng, 20)
        if engine == "reference":
            scene = {key: value.double() if isinstance(value, Tensor) else value for key, value in scene.items()}
        scene[name][0, 0] = 1e38
        with pytest.raises(ValueError, match=rf"{name} must be from -1e\+30 to 1e\+30, got 1 values beyond"):
            on(engine, rasterize, **scene, **looking(engine))

    @pytest.mark.parametrize("kind", ["face_colors", "vertex_colors"])
    def test_so_are_those_of_antialiased_pictures(self, engine, kind, rng):
        """Up to the bound the gradients are finite."""
        leaves, run = CASES[f"rasterize_antialiased/{kind}"](rng, engine)
        for name in (kind, "backgrounds"):
            for value in (1e30, 1e38, -math.inf, math.nan):
                grown = {key: leaf.clone() for key, leaf in leaves.items()}
                grown[name][0, 0] = value
                grown = {key: leaf.requires_grad_() for key, leaf in grown.items()}
                if value != 1e30:
                    with pytest.raises(ValueError, match=rf"{name} must be (finite|from -1e\+30)"):
                        run(**grown, **looking(engine))
                    continue
                run(**grown)[0].sum().backward()
                assert all(leaf.grad is not None and leaf.grad.isfinite().all() for leaf in grown.values())

    @pytest.mark.parametrize("name", ["face_colors", "backgrounds"])
    def test_the_largest_colours_leave_gradients_finite(self, name, rng):
        scene = soup(rng, 200)
        scene[name][0, 0] = 1e30
        leaves = {key: scene[key].requires_grad_() for key in ("vertices", "face_colors", "opacities", "sigma")}
        result = on("cpu", rasterize, **scene)
        (result.color.sum() + result.alpha.sum()).backward()
        for key, leaf in leaves.items():
            assert leaf.grad is not None, key
            assert leaf.grad.isfinite().all(), key
