import numpy as np
import pytest

from lerobot_symview.datasets.image_statistics import (
    HIGHEST,
    LOWEST,
    QUANTILES,
    STEP,
    ImageStatistics,
    constant_summary,
    image_summary,
)

IMAGES = {
    "rgb": [np.random.default_rng(i).integers(0, 200 + i, (9, 7, 3), dtype=np.uint8) for i in range(5)],
    "height": [np.random.default_rng(i).normal(0.05, 0.04, (9, 7)).astype(np.float32) for i in range(5)],
}


def counted(kind, images):
    statistics = ImageStatistics.empty(kind)
    for image in images:
        statistics.add(image)
    return statistics


@pytest.mark.parametrize("kind", IMAGES)
def test_statistics_equal_numpy_over_all_pixels(kind):
    values = np.stack(IMAGES[kind]).reshape(-1, 3 if kind == "rgb" else 1) / (255 if kind == "rgb" else 1)
    summary = image_summary(counted(kind, IMAGES[kind]).summary(), 5)
    assert summary["count"] == [5]
    for name in ("min", "max", "mean", "std"):
        assert np.shape(summary[name]) == (values.shape[1], 1, 1)
        expected = getattr(np, name)(values.astype(np.float64), axis=0)
        np.testing.assert_allclose(np.ravel(summary[name]), expected, rtol=1e-6)
    for name, share in QUANTILES.items():
        expected = np.quantile(values, share, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(np.ravel(summary[name]), expected, atol=1e-9 if kind == "rgb" else STEP)


@pytest.mark.parametrize("kind", IMAGES)
def test_merged_statistics_equal_those_of_all_images(kind):
    merged = counted(kind, IMAGES[kind][:2])
    merged.merge(counted(kind, IMAGES[kind][2:]))
    np.testing.assert_allclose(merged.summary(), counted(kind, IMAGES[kind]).summary(), rtol=1e-12)


@pytest.mark.parametrize("kind", IMAGES)
def test_stacked_summaries_equal_single_summaries(kind):
    summaries = [counted(kind, [image]).summary() for image in IMAGES[kind][:3]]
    many = image_summary(np.stack(summaries), [1, 2, 3])
    for index, summary in enumerate(summaries):
        assert image_summary(summary, index + 1) == {name: values[index] for name, values in many.items()}


def test_heights_outside_the_histogram_count_in_its_border_bins():
    summary = image_summary(counted("height", [np.array([[-3.0, 0.0, 5.0]], dtype=np.float32)]).summary(), 1)
    assert (np.ravel(summary["min"]), np.ravel(summary["max"])) == (-3.0, 5.0)
    np.testing.assert_allclose([np.ravel(summary["q01"]), np.ravel(summary["q99"])], [[LOWEST], [HIGHEST]])


def test_a_constant_feature_has_zero_deviation():
    summary = constant_summary(np.array([1.0, 2.0]), 7)
    assert (summary["mean"], summary["std"], summary["q50"], summary["count"]) == (
        [1.0, 2.0],
        [0.0, 0.0],
        [1.0, 2.0],
        [7],
    )
