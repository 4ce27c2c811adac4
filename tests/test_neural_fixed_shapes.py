"""The step that CUDA takes, on the CPU: nothing in it waits for the device, and it computes what the CPU's computes."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from ball_training import TINY, assert_finds_the_ball, even_rays, make_trainer
from torch.utils._python_dispatch import TorchDispatchMode
from train_settings import changed

from stages.neural import acceleration
from stages.neural.acceleration import first_rows
from stages.neural.sampling import SdfCache

# Where the host asks the device for a value or for a number of rows, or uploads a value of its own.
WAITING = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "unique_dim", "lift_fresh", "equal"}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}


class Waits(TorchDispatchMode):
    """Counts the operations that would wait for a device that works asynchronously."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()
        self.operations = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        self.operations += 1
        by_mask = name in INDEXING and any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1])
        repeats = name == "repeat_interleave" and (kwargs or {}).get("output_size") is None
        if name in WAITING or by_mask or repeats:
            self.found[name] += 1
        return func(*args, **(kwargs or {}))


@pytest.fixture
def like_cuda(monkeypatch):
    """The CPU is treated as CUDA is: shapes that stay, and plain PyTorch in place of the CPU's kernels."""

    def switch() -> None:
        monkeypatch.setattr(acceleration, "ASYNCHRONOUS", {"cuda", "cpu"})
        monkeypatch.setattr(acceleration, "_has_numba", lambda: False)

    return switch


def waits_of_steps(trainer) -> Waits:
    """In the steps at the beginning, in the middle and at the end, with full and partial refreshes of the grid."""
    trainer.step(0.0)  # the optimiser makes its state
    with Waits() as waits:
        for step in range(1, 6 * TINY.sampling.cache_every):
            trainer.step_index = step
            trainer.step(step / (6 * TINY.sampling.cache_every))
    return waits


@pytest.mark.slow
@pytest.mark.parametrize(("masks", "precision"), [(False, "mixed"), (True, "float32")])
def test_a_step_does_not_wait_for_the_device(like_cuda, masks, precision):
    like_cuda()
    settings = {"sampling.rays": 16, "precision": precision}
    waits = waits_of_steps(make_trainer(changed(TINY, settings), masks=masks))
    assert waits.operations > 1000
    assert not waits.found


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("masks", [False, True])
def test_a_step_on_cuda_does_not_wait(masks):
    trainer = make_trainer(masks=masks, device="cuda")
    for step in range(3):  # kernels are compiled and tried, the optimiser makes its state
        trainer.step(0.1 * step)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for step in range(3, 6 * TINY.sampling.cache_every):
            numbers = trainer.step(step / (6 * TINY.sampling.cache_every))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.isfinite(numbers["loss"]).item()


@pytest.mark.slow
def test_the_step_of_the_cpu_would_wait(monkeypatch):
    """What the test above looks for is found where it is."""
    monkeypatch.setattr(acceleration, "_has_numba", lambda: False)
    waits = waits_of_steps(make_trainer(changed(TINY, {"sampling.rays": 16})))
    assert waits.found["nonzero"] >= 2 * (6 * TINY.sampling.cache_every - 1)


@pytest.mark.parametrize(
    "expression",
    [
        lambda x: x[x > 0],
        lambda x: x.sum().item(),
        lambda x: x.masked_fill_(x > 0, 1.0)[torch.tensor([0, 1])],
        lambda x: torch.unique(x),
        lambda x: bool((x > 0).any()),
        lambda x: x.repeat_interleave(torch.ones(4, dtype=torch.long)),
    ],
)
def test_waiting_is_noticed(expression):
    with Waits() as waits:
        expression(torch.arange(4.0))
    assert waits.found


@pytest.mark.parametrize("masks", [False, True])
@pytest.mark.parametrize("progress", [0.0, 0.6])
def test_rays_look_the_same_in_both_forms(like_cuda, masks, progress):
    forms = []
    for switch in (lambda: None, like_cuda):
        switch()
        trainer = make_trainer(masks=masks)
        trainer._refresh_cache(trainer.moment(progress))
        batch = even_rays(trainer.photos, TINY.sampling.rays)
        rendered = trainer.render(batch, progress, torch.zeros(3, 3) + 0.2)
        (rendered.colors - batch.colors).square().mean().backward()
        forms.append((batch, rendered, trainer.fields))
    (batch, rendered, fields), (other_batch, other_rendered, other_fields) = forms
    assert torch.equal(batch.drawn, other_batch.drawn)
    for name in ("colors", "opacity", "gradients", "extra_sdf"):
        torch.testing.assert_close(getattr(other_rendered, name), getattr(rendered, name), rtol=1e-4, atol=1e-4)
    for (name, parameter), other in zip(fields.named_parameters(), other_fields.parameters(), strict=True):
        if parameter.grad is not None:
            scale = float(parameter.grad.abs().max())
            torch.testing.assert_close(other.grad, parameter.grad, rtol=1e-2, atol=2e-3 * scale + 1e-9, msg=name)


@pytest.mark.slow
def test_the_form_without_waits_learns_the_ball(like_cuda):
    like_cuda()
    assert_finds_the_ball({})


def test_the_first_rows_are_those_chosen_and_then_again():
    chosen = torch.tensor([False, True, False, True, True, False])
    assert first_rows(chosen, 2).tolist() == [1, 3]
    assert first_rows(chosen, 5).tolist() == [1, 3, 4, 1, 3]
    assert first_rows(chosen.fill_(False), 2).tolist() == [5, 5]


def test_as_many_rays_as_asked_for_where_few_meet_the_sphere(like_cuda):
    like_cuda()
    photos = make_trainer().photos
    photos.boxes[:] = torch.tensor([0.0, 0, 48, 2])  # the top of the photos, where hardly a ray meets it
    batch = even_rays(photos, 64)
    distinct = batch.drawn.unique()
    assert len(batch.drawn) == 64
    assert 0 < len(distinct) < 64
    assert torch.equal(batch.drawn, distinct.repeat(64)[:64])
    assert (batch.leave > batch.entry).all()


def test_a_refresh_near_the_surface_takes_a_fixed_part_of_the_grid(like_cuda):
    like_cuda()
    cache = SdfCache(24, "cpu")
    cache.refresh(lambda p: p.norm(dim=1) - 0.5)
    kept = cache.values.view(-1)[cache.inside]
    assert cache.refresh(lambda p: torch.full((len(p),), 9.0), 4 * cache.cell) == len(kept) // 2
    renewed = cache.values.view(-1)[cache.inside] == 9
    assert kept[renewed].abs().max() <= kept[~renewed].abs().min()
    assert kept[renewed].abs().max() > 2 * cache.cell


def test_a_graph_reads_what_changes_from_tensors():
    """As CUDA replays it: the scale and the sightings' weight come as tensors, and the step is the same."""
    plain, replayed = make_trainer(), make_trainer()
    replayed.replay = lambda step, kind: step()
    for progress in (0.0, 0.2, 0.5):
        expected, got = plain.step(progress), replayed.step(progress)
        torch.testing.assert_close(got["loss"], expected["loss"], rtol=1e-4, atol=1e-6)
    assert replayed._scale.item() == pytest.approx(plain.moment(0.5).scale)


def test_a_graph_is_recorded_anew_where_the_planar_term_begins():
    trainer, kinds = make_trainer(), []

    def replay(step, kind):
        kinds.append(kind)
        return step()

    trainer.replay = replay
    for progress in (0.48, 0.49, 0.5, 0.51):
        trainer.step(progress)
    assert kinds[0] == kinds[1] != kinds[2] == kinds[3]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_step_on_cuda_is_replayed_and_learns_the_same():
    replayed, plain = make_trainer(device="cuda"), make_trainer(device="cuda")
    plain.replay = None
    losses = {}
    for name, trainer in (("replayed", replayed), ("plain", plain)):
        losses[name] = torch.tensor([trainer.step(0.3 + step / 1000)["loss"].item() for step in range(12)])
    assert replayed.replay.recording.graph is not None
    assert len(losses["replayed"].unique()) == 12  # each step draws anew
    torch.testing.assert_close(losses["replayed"], losses["plain"], rtol=1e-2, atol=1e-4)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_checkpoint_of_the_cpu_goes_on_on_cuda():
    started, going_on = make_trainer(), make_trainer(device="cuda")
    for _ in range(2):
        started.step(0.1)
    state = started.state()
    state["generator"] = going_on.generator.get_state()  # that of a CPU means nothing to a GPU
    going_on.load_state(state)
    before = going_on.fields.sdf.table.detach().clone()
    for _ in range(6):
        numbers = going_on.step(0.2)
    assert torch.isfinite(numbers["loss"])
    assert not torch.equal(going_on.fields.sdf.table, before)
    assert all(isinstance(group["lr"], torch.Tensor) for group in going_on.optimizer.param_groups)


def test_a_checkpoint_of_cuda_goes_on_on_the_cpu():
    started, going_on = make_trainer(), make_trainer()
    started.step(0.1)
    state = started.state()
    for group in state["optimizer"]["param_groups"]:  # as the GPU leaves them
        group |= {"lr": torch.tensor(group["lr"]), "capturable": True}
    going_on.load_state(state)
    assert torch.isfinite(going_on.step(0.2)["loss"])
    assert all(isinstance(group["lr"], float) for group in going_on.optimizer.param_groups)
