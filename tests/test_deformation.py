"""The motion field: identity at frame 0, smooth between frames, and the same after a round trip through its file."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from masiv.errors import InputError
from masiv.splat.deformation import DeformationNetwork, time_octave_limit


def make(frame_count=12, fps=24.0, seed=0, base=None, **settings):
    torch.manual_seed(seed)
    if base is None:
        base = torch.randn(frame_count, 3) * 0.1
    network = DeformationNetwork(
        centre=torch.tensor([0.1, 0.5, -0.2]),
        half_extent=0.3,
        frame_count=frame_count,
        fps=fps,
        base_motion=base,
        **settings,
    )
    for parameter in network.motion[-1].parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network


@pytest.mark.parametrize("frame_count", [2, 3, 5, 16])
def test_canonical_shape_is_frame_zero(frame_count):
    network = make(frame_count)
    positions = torch.randn(7, 3)
    displacement, log_scale = network(positions, 0.0)
    assert displacement.abs().max() < 1e-6
    assert log_scale.abs().max() < 1e-6
    displacement, log_scale = network(positions, (frame_count - 1) / 24)
    assert displacement.shape == (7, 3)
    assert log_scale.shape == (7,)
    assert displacement.abs().max() > 1e-3


def test_a_fresh_network_follows_the_spline_through_the_base_motion():
    base = torch.randn(9, 3, dtype=torch.float64)
    network = DeformationNetwork(
        centre=torch.zeros(3), half_extent=1.0, frame_count=9, fps=30.0, base_motion=base
    ).double()
    times = torch.linspace(0, 8 / 30, 50, dtype=torch.float64)
    with torch.no_grad():
        moved = network.displacements(torch.randn(4, 3, dtype=torch.float64), times)
    expected = CubicSpline(np.arange(9) / 30, base.float().numpy(), bc_type="natural")(times.numpy())
    expected -= base.float().numpy()[0]
    np.testing.assert_allclose(moved.numpy(), np.repeat(expected[:, None], 4, 1), atol=2e-6)


def test_many_times_agree_with_one_time():
    network = make()
    positions = torch.randn(11, 3)
    times = torch.tensor([0.0, 0.1, 0.33])
    together = network.displacements(positions, times)
    for k, time in enumerate(times):
        torch.testing.assert_close(together[k], network(positions, float(time))[0], atol=1e-6, rtol=1e-5)


def test_no_wiggle_between_frames_after_a_fit():
    """Fitted at the frames alone to x -> (stretch along t^2), the network is right half-way between the frames too."""
    torch.manual_seed(1)
    positions = torch.rand(200, 3) - 0.5
    times = torch.arange(10) / 24

    def truth(t):
        return positions[None] * (t[:, None, None] * 24 / 9) ** 2 * torch.tensor([0.3, -0.2, 0.1])

    network = DeformationNetwork(
        centre=torch.zeros(3), half_extent=0.5, frame_count=10, fps=24.0, base_motion=torch.zeros(10, 3), width=32
    )
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    for _ in range(300):
        optimiser.zero_grad()
        (network.displacements(positions, times) - truth(times)).square().mean().backward()
        optimiser.step()
    with torch.no_grad():
        at = (network.displacements(positions, times) - truth(times)).abs().mean()
        middle = times[:-1] + 0.5 / 24
        between = (network.displacements(positions, middle) - truth(middle)).abs().mean()
    assert at < 4e-3
    assert between < 1.5 * at + 1e-4


def test_time_octaves_stay_below_nyquist():
    assert [time_octave_limit(t) for t in (2, 3, 5, 9, 12, 16, 30)] == [0, 1, 2, 3, 3, 3, 4]
    for count in range(2, 60):
        octaves = time_octave_limit(count)
        assert octaves == 0 or 2 ** (octaves - 1) / 2 <= (count - 1) / 4
    assert make(3, time_octaves=6).settings["time_octaves"] == 1


def test_file_round_trip(tmp_path):
    network = make(5, bases=3, width=16, depth=1)
    network.save(tmp_path / "motion.safetensors")
    again = DeformationNetwork.load(tmp_path / "motion.safetensors")
    positions = torch.randn(6, 3)
    assert torch.equal(network(positions, 0.07)[0], again(positions, 0.07)[0])
    assert [p.name for p in tmp_path.iterdir()] == ["motion.safetensors"]


def test_bad_files_and_settings_are_named(tmp_path):
    with pytest.raises(InputError, match=r"nothing.safetensors is not a motion"):
        DeformationNetwork.load(tmp_path / "nothing.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"12345678{}")
    with pytest.raises(InputError, match="not a motion"):
        DeformationNetwork.load(tmp_path / "bad.safetensors")
    with pytest.raises(InputError, match="2 frames or more"):
        make(1, base=torch.zeros(1, 3))
