import pytest
import torch

from etsplat.core.rasterization import TriangleStatistics
from etsplat.ops.adam import Adam
from etsplat.optim.densification import PruneRules, SoupStatistics, dead_triangles, densify_plan, grown_count
from etsplat.optim.edit import RowPlan, apply_rows

RULES = PruneRules(opacity=0.014, importance=0.022, views=2, screen_size=1400)


def soup_tensors(rng: torch.Generator, count: int):
    vertices = torch.randn((count, 3, 3), generator=rng)
    return vertices, torch.randn(count, generator=rng), 0.1 + torch.rand(count, generator=rng)


def plan_for(rng, count=40, target=60, screen_size=None, dead=None, by="opacity", barren=None):
    vertices, logits, sigma = soup_tensors(rng, count)
    plan = densify_plan(
        vertices,
        logits,
        sigma,
        torch.ones(count) if screen_size is None else screen_size,
        torch.zeros(count, dtype=torch.bool) if dead is None else dead,
        target=target,
        by=by,
        barren=barren,
        split_size=24.0,
        noise=1.5,
        generator=rng,
    )
    return plan, vertices, logits


def rendering(count: int, weight: float = 1.0, inradius: float = 5.0, size: float = 10.0) -> TriangleStatistics:
    full = torch.ones(1, count)
    return TriangleStatistics(weight * full, size * full, inradius * full, full > 0)


def test_clones_cover_as_much_as_their_parent(rng):
    """Two coincident copies of the new opacity composite to the old one; one copy stays, one moves in its plane."""
    plan, vertices, logits = plan_for(rng)
    children = plan.values["opacity_logits"]
    parents = plan.source[plan.fresh]
    half = len(parents) // 2
    assert torch.equal(parents[:half], parents[half:])
    opacity = torch.sigmoid(children)
    torch.testing.assert_close(1 - (1 - opacity) ** 2, torch.sigmoid(logits[parents]))
    stay, moved = plan.values["vertices"].split(half)
    assert torch.equal(stay, vertices[parents[:half]])
    shift = moved - stay
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift), rtol=0, atol=1e-5)
    normal = torch.linalg.cross(stay[:, 1] - stay[:, 0], stay[:, 2] - stay[:, 0])
    assert float((shift[:, 0] * normal).sum(dim=1).abs().max()) < 1e-4


def test_large_parents_split_into_four_that_cover_them(rng):
    """Parts have a quarter of the area each, and together the corners of the parent."""
    plan, vertices, logits = plan_for(rng, screen_size=torch.full((40,), 30.0))
    parts = plan.values["vertices"].reshape(-1, 4, 3, 3)
    parents = vertices[plan.source[plan.fresh]].reshape(-1, 4, 3, 3)[:, 0]

    def area(t):
        return torch.linalg.cross(t[..., 1, :] - t[..., 0, :], t[..., 2, :] - t[..., 0, :]).norm(dim=-1)

    torch.testing.assert_close(area(parts), area(parents)[:, None].expand(-1, 4) / 4, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(torch.stack([parts[:, k, k] for k in range(3)], dim=1), parents)
    assert torch.equal(plan.values["opacity_logits"], logits[plan.source[plan.fresh]])


@pytest.mark.parametrize("target", [40, 41, 57, 60, 500])
def test_budget_is_never_exceeded(rng, target):
    """Whatever mixture of clones and splits is drawn, there are at most `target` triangles, and nearly as many."""
    size = torch.where(torch.arange(40) % 2 == 0, 30.0, 3.0)
    dead = torch.arange(40) % 5 == 0
    plan, _, _ = plan_for(rng, target=target, screen_size=size, dead=dead)
    assert len(plan.source) <= target
    assert len(plan.source) >= min(target - 3, 32 + 32 + 2 * 16 - 3)
    assert not bool(dead[plan.source].any())
    survivors = plan.source[~plan.fresh]
    assert not set(survivors.tolist()) & set(plan.source[plan.fresh].tolist())


def test_drawing_follows_the_weights(rng):
    """Opaque, or sharp, triangles are drawn more often, in proportion."""
    counts = torch.zeros(2)
    for _ in range(300):
        logits, sigma = torch.tensor([0.0, -1.0986]), torch.tensor([0.3, 0.1])  # opacities 1/2 and 1/4
        vertices = torch.rand((2, 3, 3), generator=rng)
        common = (torch.ones(2), torch.zeros(2, dtype=torch.bool))
        for column, by in enumerate(("opacity", "sharpness")):
            plan = densify_plan(
                vertices, logits, sigma, *common, target=3, by=by, split_size=24, noise=1, generator=rng
            )
            counts[column] += int(plan.source[plan.fresh][0]) == 0
    assert float(counts[0]) == pytest.approx(200, abs=30)
    assert float(counts[1]) == pytest.approx(75, abs=30)


def test_the_same_generator_gives_the_same_plan():
    """Every random choice comes from the generator."""
    plans = [plan_for(torch.Generator().manual_seed(3))[0] for _ in range(2)]
    assert torch.equal(plans[0].source, plans[1].source)
    assert torch.equal(plans[0].values["vertices"], plans[1].values["vertices"])


def test_growth_is_by_the_factor_up_to_the_cap():
    """The soup never shrinks by growing."""
    assert grown_count(100, 1.3, 1000) == 130
    assert grown_count(100, 1.3, 110) == 110
    assert grown_count(100, 1.3, 50) == 100


def test_faint_triangles_die_at_once_and_others_after_a_trial():
    """Before the epoch is over only opacity counts; after it, importance, views and size do."""
    statistics = SoupStatistics.zeros(5)
    opacities = torch.tensor([0.01, 0.5, 0.5, 0.5, 0.5])
    weight = torch.tensor([[1.0, 0.01, 1.0, 1.0, 1.0]])
    size = torch.tensor([[9.0, 9, 9, 2000, 9]])
    inradius = torch.tensor([[5.0, 5, 0.2, 5, 5]])
    for view in range(3):
        dead = dead_triangles(opacities, statistics, RULES, views=3)
        assert dead.tolist() == [True, False, False, False, False]
        statistics.update(TriangleStatistics(weight, size, inradius, weight > 0), 3, epoch_starts=view == 0)
    assert dead_triangles(opacities, statistics, RULES, views=3).tolist() == [True, True, True, True, False]


def test_a_trial_is_one_whole_epoch():
    """It begins with an epoch, counts each view once, and waits again after a verdict."""
    statistics = SoupStatistics.zeros(1)
    for step in range(11):  # epochs of 4 that start at steps 2, 6, 10
        statistics.update(rendering(1), 4, epoch_starts=step % 4 == 2)
        assert int(statistics.trial) == min(max(step - 1, 0), 4)
        assert int(statistics.seen) == int(statistics.trial)
    statistics.restart(statistics.judged(4))
    statistics.update(rendering(1), 4, epoch_starts=False)
    assert int(statistics.trial) == 0


@pytest.mark.parametrize("by", ["opacity", "sharpness"])
def test_who_is_barren_has_no_children(rng, by):
    """Whatever its opacity and softness."""
    plan, *_ = plan_for(rng, by=by, barren=torch.arange(40) % 4 != 0)
    assert len(plan.source[plan.fresh].unique()) == 10
    assert bool((plan.source[plan.fresh] % 4 == 0).all())


@pytest.mark.parametrize("views", [20, 300, 520, 1300])
def test_many_views_never_condemn_everything(views):
    """With an edit every 500 iterations, visible triangles live and others die, however many views there are."""
    statistics = SoupStatistics.zeros(2)
    inradius = torch.tensor([[5.0, 0.1]])
    died = False
    for step in range(4000):
        stats = TriangleStatistics(torch.ones(1, 2), torch.ones(1, 2), inradius, inradius > 0)
        statistics.update(stats, views, epoch_starts=step % views == 0)
        if step % 500 == 499:
            dead = dead_triangles(torch.full((2,), 0.5), statistics, RULES, views)
            assert not bool(dead[0])
            died |= bool(dead[1])
            statistics.restart(statistics.judged(views))
    assert died


def test_rows_move_together_with_their_moments_and_statistics(rng):
    """Survivors keep everything; fresh rows have their values, zero moments and zero statistics."""
    parameters = {"vertices": torch.rand((4, 3, 3), generator=rng), "sigma_raw": torch.rand(4, generator=rng)}
    adam = Adam({n: t.clone().requires_grad_() for n, t in parameters.items()}, {"vertices": 0.1, "sigma_raw": 0.1})
    for parameter in adam.parameters.values():
        parameter.grad = torch.rand(parameter.shape, generator=rng)
    adam.step()
    old = {n: (adam.parameters[n].detach(), adam.first_moments[n], adam.second_moments[n]) for n in parameters}
    plan = RowPlan(
        4, torch.tensor([3, 0, 2, 2]), torch.tensor([False, False, True, True]), {"vertices": torch.ones(2, 3, 3)}
    )
    new, statistics = apply_rows(plan, adam, {"seen": torch.tensor([1, 2, 3, 4])})
    assert statistics["seen"].tolist() == [4, 1, 0, 0]
    for name, (value, first, second) in old.items():
        assert torch.equal(new[name][:2], value[[3, 0]])
        assert torch.equal(adam.first_moments[name][:2], first[[3, 0]])
        assert torch.equal(adam.second_moments[name][:2], second[[3, 0]])
        assert float(adam.first_moments[name][2:].abs().max()) == 0
        assert float(adam.second_moments[name][2:].abs().max()) == 0
        assert adam.parameters[name] is new[name]
        assert new[name].is_leaf
        assert new[name].requires_grad
    assert torch.equal(new["vertices"][2:], torch.ones(2, 3, 3))
    assert torch.equal(new["sigma_raw"][2:], old["sigma_raw"][0][[2, 2]])


def test_plans_that_do_not_fit_change_nothing(rng):
    """A wrong number of rows or values is refused before anything moves."""
    value = torch.rand(4, generator=rng, requires_grad=True)
    adam = Adam({"sigma_raw": value}, {"sigma_raw": 0.1})
    with pytest.raises(ValueError, match="sigma_raw"):
        apply_rows(RowPlan.keeping(torch.ones(5) > 0), adam, {})
    with pytest.raises(ValueError, match="seen"):
        apply_rows(RowPlan.keeping(torch.ones(4) > 0), adam, {"seen": torch.zeros(3)})
    plan = RowPlan(4, torch.arange(4), torch.arange(4) > 2, {"sigma_raw": torch.zeros(3)})
    with pytest.raises(ValueError, match="values"):
        apply_rows(plan, adam, {})
    assert adam.parameters["sigma_raw"] is value


def test_whom_no_view_has_seen_has_no_children(rng):
    """Its size on screen is unknown, and nobody would see them."""
    plan, _, _ = plan_for(rng, count=4, target=9, screen_size=torch.tensor([5.0, 5, 0, 0]))
    assert set(plan.source[plan.fresh].tolist()) == {0, 1}
