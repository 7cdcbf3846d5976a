import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Exposure
from sharpfield.simulation.sensors.frames import Exposing, FrameSensor, decode, encode, store


def exposures(*spans: tuple[int, int]) -> Exposure:
    return Exposure(*(np.array(column, np.int64) for column in zip(*spans, strict=True)))


def show(exposing: Exposing, times, light) -> np.ndarray:
    """Means of exposures while the light of all pixels is `light(t)`."""
    for t in times:
        rgb = np.empty((4, 5, 3), np.float32)
        rgb[:] = light(t)
        exposing.see(rgb, int(t))
    return exposing.means()


def test_still_light_blurs_nothing():
    image = np.random.default_rng(0).uniform(size=(4, 5, 3)).astype(np.float32)
    means = show(
        Exposing(exposures((0, 30), (35, 35), (40, 70)), (5, 4)), range(0, 71, 7), lambda t: image
    )
    np.testing.assert_allclose(means, np.broadcast_to(image, means.shape), rtol=1e-6)


def test_the_mean_of_straight_light_is_that_of_the_middle():
    """Whatever the instants at which it is looked at, on the ends of exposures or not."""
    spans = exposures((0, 100), (130, 190), (195, 195), (200, 201), (333, 400))
    times = [0, 7, 90, 131, 140, 250, 399, 400]
    means = show(Exposing(spans, (5, 4)), times, lambda t: 0.002 * t)
    expected = 0.001 * (spans.open_us + spans.close_us)
    np.testing.assert_allclose(means[:, 0, 0, 0], expected, rtol=1e-5)
    assert means.shape == (5, 4, 5, 3) and (means == means[:, :1, :1, :1]).all()


def test_against_an_integral():
    means = show(
        Exposing(exposures((1000, 9000)), (5, 4)),
        range(0, 10_001, 20),
        lambda t: np.sin(t / 2500) ** 2,
    )
    t = np.linspace(1000, 9000, 200_001)
    assert abs(means[0, 1, 2, 1] - (np.sin(t / 2500) ** 2).mean()) < 1e-5


def test_rows_of_a_rolling_shutter_follow_each_other():
    exposing = Exposing(exposures((100, 200), (400, 400)), (5, 4), row_delay_us=25.0)
    means = show(exposing, range(0, 701, 50), lambda t: 0.001 * t)
    np.testing.assert_allclose(means[0, :, 0, 0], 0.150 + 0.025 * np.arange(4), rtol=1e-5)
    np.testing.assert_allclose(means[1, :, 0, 0], 0.400 + 0.025 * np.arange(4), rtol=1e-5)


@pytest.mark.parametrize("encoding", ["linear", "gamma2.2", "srgb"])
def test_curves_are_undone_and_keep_black_and_white(encoding):
    light = np.linspace(0, 1, 1001, dtype=np.float32).reshape(1, -1, 1)
    display = encode(light, encoding)
    np.testing.assert_allclose(decode(display, encoding), light, atol=2e-6)
    assert display.min() == 0 and abs(display.max() - 1) < 1e-6
    assert (np.diff(display[0, :, 0]) > 0).all()


def test_light_is_stored_rounded_and_clipped():
    light = np.array([[[0.0, 0.5, 1.0, 1.7, -0.1]]], np.float32)[..., None]
    draw = np.random.default_rng(0)
    stored = store(light, FrameSensor(), draw)
    assert stored.dtype == np.uint8
    np.testing.assert_array_equal(stored.ravel(), [0, round(255 * 0.5 ** (1 / 2.2)), 255, 255, 0])
    fine = store(light, FrameSensor("linear", 16), draw)
    assert fine.dtype == np.uint16 and list(fine.ravel()) == [0, 32768, 65535, 65535, 0]


def test_photon_and_read_noise_have_their_size():
    light = np.full((1, 200, 200, 3), 0.3, np.float32)
    sensor = FrameSensor("linear", 16, full_well=2000.0, read_noise=0.005)
    stored = store(light, sensor, np.random.default_rng(0)) / 65535
    expected = np.sqrt(0.3 / 2000 + 0.005**2)
    assert abs(stored.mean() - 0.3) < 2e-4 and abs(stored.std() / expected - 1) < 0.02
    clean = store(light, sensor.noiseless(), np.random.default_rng(0)) / 65535
    assert np.ptp(clean) == 0


def test_images_must_cover_exposures():
    exposing = Exposing(exposures((0, 100)), (5, 4))
    with pytest.raises(
        OptionError, match="do not cover.*\n  where  exposure 0\n  got    60 of 100 us"
    ):
        show(exposing, [0, 30, 60], lambda t: 1.0)


def test_a_sensor_says_what_is_wrong_with_it():
    with pytest.raises(OptionError, match="response curve\n  got    log"):
        FrameSensor("log")
    with pytest.raises(OptionError, match="8 or 16 bits\n  got    12"):
        FrameSensor(bits=12)
