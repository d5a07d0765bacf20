import torch

from stages.avatar.model.person import Canonical
from stages.training.seen import as_body_where_unseen


def test_rows_never_shown_are_as_the_body_says():
    parts = [torch.randn(3, *shape) for shape in ((3,), (3, 3), (3,), (), (1, 3), (24,), (3,))]
    a, b = Canonical(*parts), Canonical(*(-part for part in parts))
    out = as_body_where_unseen(a, b, torch.tensor([1.0, 0.0, 1e-4]))
    for x, y, z in zip(out, a, b, strict=True):
        assert torch.equal(x, torch.cat([y[:1], z[1:]]))
