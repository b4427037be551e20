from __future__ import annotations

import pytest
import torch

from gausim.ops.orbit import orbit_cameras


@pytest.mark.parametrize("up", ["z", "y", "-y", "x"])
def test_cameras_see_the_scene_upright_and_in_the_middle(up: str):
    means = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) + 5.0
    cameras = orbit_cameras(means, azimuths=(0.0, 90.0, 200.0), up=up, size=(64, 48)).validated("orbit")
    assert cameras.names == ("azimuth_0", "azimuth_90", "azimuth_200")
    vertical = torch.zeros(3)
    vertical["xyz".index(up[-1])] = -0.2 if up.startswith("-") else 0.2
    middle = means.median(0).values
    for viewmat, k in zip(cameras.viewmats, cameras.Ks, strict=True):
        points = torch.cat((means, middle[None], (middle + vertical)[None])) @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = points @ k.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert (points[:, 2] > 0).all()
        inside = (pixels >= 0) & (pixels <= torch.tensor([64.0, 48.0]))
        assert inside.all(-1).float().mean() > 0.97
        assert torch.allclose(pixels[-2], torch.tensor([32.0, 24.0]), atol=1e-2)
        assert pixels[-1, 1] < pixels[-2, 1] - 1  # up in the world is up in the picture
    between = torch.cdist(cameras.centers, cameras.centers)
    assert (between + 10 * torch.eye(3)).min() > 1
