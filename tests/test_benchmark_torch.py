"""What the benchmark compares with is the same agent: PyTorch's logits, losses and gradients equal ours, and so do the parameters."""

import jax
import numpy as np
import pytest

from experiments import benchmark_stages
from lala_jax.models import transporter

SMALL = {"yaw_bins": 4, "crop": 8, "channels": 3, "width": 8, "stages": 2}


@pytest.fixture(scope="module")
def reference():
    pytest.importorskip("torch", reason="PyTorch is not installed (extra `benchmark`): its comparisons are not tested")
    from experiments import benchmark_torch

    return benchmark_torch


def init(net, example):
    return net.init(jax.random.key(0, impl="rbg"), example["current"], example["goal"], example["pick"])["params"]


def test_the_same_parameters_give_the_same_logits_losses_and_gradients(reference):
    import torch

    example = benchmark_stages.paper_example(40, 24)
    net = transporter.Transporter(**SMALL)
    params = jax.jit(lambda: init(net, example))()
    bias = jax.random.split(jax.random.key(1), len(jax.tree.leaves(params)))
    params = jax.tree.unflatten(
        jax.tree.structure(params),
        [x + 0.1 * jax.random.normal(key, x.shape) for x, key in zip(jax.tree.leaves(params), bias, strict=True)],
    )
    step = jax.jit(jax.value_and_grad(lambda params: benchmark_stages.paper_losses(net, params, example), has_aux=True))
    (loss, logits), grads = step(params)
    twin = reference.Transporter(**SMALL)
    reference.load(twin, params)
    torch_loss, (pick, place) = reference.losses(twin, example)
    assert float(np.ptp(logits["pick"])) > 0.1 and float(np.ptp(logits["place"])) > 0.1
    np.testing.assert_allclose(pick.detach(), logits["pick"], atol=1e-4, rtol=1e-4)
    np.testing.assert_allclose(place.detach(), logits["place"], atol=1e-4, rtol=1e-4)
    assert torch_loss.item() == pytest.approx(float(loss), abs=1e-4)
    torch_loss.backward()
    there = reference.Transporter(**SMALL)
    reference.load(there, grads)
    for (name, wanted), found in zip(there.named_parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(found.grad, wanted.data, atol=1e-4, rtol=1e-3, msg=lambda text, name=name: f"{name}: {text}")


def test_the_sizes_are_the_papers(reference):
    net = reference.Transporter()
    sizes = [sum(x.numel() for x in part.parameters()) for part in (net.pick_net.current, net)]
    example = benchmark_stages.paper_example(320, 160)
    params = jax.eval_shape(lambda: init(transporter.Transporter(), example))
    assert sizes[0] == pytest.approx(9.82e6, rel=1e-3)
    assert sizes == [sum(x.size for x in jax.tree.leaves(tree)) for tree in (params["pick_net"]["current"], params)]


def test_correlations_do_the_same(reference, monkeypatch):
    """PyTorch's gradients of the mean square of the scores equal those of the stage `correlate`."""
    import torch

    from lala_jax.models import correlation

    rng = np.random.default_rng(0)
    key, kernels = rng.normal(size=(12, 10, 3)).astype(np.float32), rng.normal(size=(4, 6, 6, 3)).astype(np.float32)
    given = iter([torch.tensor(key.transpose(2, 0, 1)[None]), torch.tensor(kernels.transpose(0, 3, 1, 2))])
    monkeypatch.setattr(torch, "randn", lambda *shape, requires_grad: next(given).reshape(shape).requires_grad_(requires_grad))
    found = reference.correlate(rotations=4, rows=12, cols=10, crop=6).run()
    wanted = jax.grad(lambda *x: (correlation.correlate(*x, method="fft") ** 2).mean(), (0, 1))(key, kernels)
    np.testing.assert_allclose(found[0][0].permute(1, 2, 0), wanted[0], atol=1e-4)
    np.testing.assert_allclose(found[1].permute(0, 2, 3, 1), wanted[1], atol=1e-4)
