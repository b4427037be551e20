"""Planes of features: bilinear values, borders, products and sums, penalties by hand."""

import pytest
import torch

from gausim.nn.planes import Planes


def test_a_hexplane_has_six_planes_and_does_not_depend_on_time_at_first() -> None:
    planes = Planes([4, 5, 6, 3], 7)
    sizes = [(5, 4), (6, 4), (3, 4), (6, 5), (3, 5), (3, 6)]
    assert [tuple(p.shape[1:]) for p in planes.planes] == [(7, *size) for size in sizes]
    points = torch.rand(20, 4) * 2 - 1
    later = points.clone()
    later[:, 3] = 0.9
    torch.testing.assert_close(planes(points), planes(later))


@pytest.mark.parametrize("combine", ["sum", "product"])
def test_values_are_bilinear_between_corners_and_constant_beyond(combine: str) -> None:
    planes = Planes([2, 2, 2], 1, combine=combine)
    with torch.no_grad():
        for n, plane in enumerate(planes.planes):
            plane.copy_(torch.tensor([[1.0, 2.0], [3.0, 5.0]]) + n)
    points = torch.tensor([[-1.0, -1, -1], [0.5, -0.5, 0], [9, 9, 9]])
    corner = [[1.0, 2.0, 3.0], None, [5.0, 6.0, 7.0]]

    def bilinear(n: int, a: float, b: float) -> float:
        u, w = (a + 1) / 2, (b + 1) / 2
        return (1 - u) * (1 - w) * (1 + n) + u * (1 - w) * (2 + n) + (1 - u) * w * (3 + n) + u * w * (5 + n)

    corner[1] = [bilinear(0, 0.5, -0.5), bilinear(1, 0.5, 0), bilinear(2, -0.5, 0)]
    for row, values in zip(planes(points), corner, strict=True):
        assert values is not None
        expected = sum(values) if combine == "sum" else values[0] * values[1] * values[2]
        assert float(row) == pytest.approx(expected)


def test_penalties_look_along_their_own_axes() -> None:
    planes = Planes([3, 3, 3, 4], 2)
    with torch.no_grad():
        for plane in planes.planes:
            plane.fill_(0.3)
    assert float(planes.variation()) == float(planes.unsteadiness()) == 0
    with torch.no_grad():
        planes.planes[2].copy_(torch.tensor([0.0, 1, 2, 3])[:, None].expand(4, 3))  # (x, t): steady growth in time
    assert float(planes.variation()) == 0 and float(planes.unsteadiness()) == pytest.approx(0, abs=1e-12)
    with torch.no_grad():
        planes.planes[2].copy_(torch.tensor([0.0, 1, 0, 1])[:, None].expand(4, 3))
        planes.planes[0].copy_(torch.tensor([0.0, 1, 2]).expand(3, 3))  # (x, y): slope 1 along x
    assert float(planes.unsteadiness()) == pytest.approx(4) and float(planes.variation()) == pytest.approx(1)
