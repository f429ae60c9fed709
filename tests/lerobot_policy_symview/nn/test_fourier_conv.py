"""The convolution in the Fourier domain against the dense convolution, its specification."""

import copy
import multiprocessing
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import numpy as np
import pytest
import torch

from lerobot_policy_symview.nn.fourier_conv import FourierConv2d, Plan
from lerobot_policy_symview.nn.layers import FieldConv2d
from lerobot_policy_symview.nn.threads import in_threads
from lerobot_policy_symview.symmetry.groups import make_group

D4 = make_group("D4")
SCALARS = np.stack([np.eye(3)] * D4.size)
VECTORS = D4.rotation()
TOLERANCES = {torch.float64: 2e-11, torch.float32: 2e-5}


@pytest.fixture(autouse=True)
def two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)


def layers(inputs, fields, padding, dtype=torch.float64, group=D4):
    """Return a dense and a Fourier layer with the same weights."""
    torch.manual_seed(0)
    dense, fast = (kind(group, inputs, fields, padding).to(dtype) for kind in (FieldConv2d, FourierConv2d))
    torch.nn.init.normal_(dense.bias)
    fast.load_state_dict(dense.state_dict())
    return dense, fast


def images_for(layer, batch=2, height=8, width=8):
    return torch.randn(batch, layer.weight.shape[1], height, width, dtype=layer.weight.dtype)


def assert_near(actual, expected):
    limit = TOLERANCES[expected.dtype] * expected.abs().max()
    assert actual.dtype == expected.dtype
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= limit


def is_fast(layer, images, pool=False):
    return layer.plan(images, pool) is not None


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize(
    ("inputs", "fields", "height", "width", "padding", "pool", "batch"),
    [
        (2, 3, 8, 8, 1, True, 3),
        (2, 3, 8, 6, 0, True, 1),
        (3, 2, 7, 9, 1, False, 3),
        (1, 1, 3, 3, 0, False, 5),
        (8, 4, 6, 6, 1, False, 1),
        (2, 1, 36, 32, 1, True, 3),
        (1, 2, 4, 256, 1, True, 1),
        (1, 1, 5, 200, 0, False, 2),
        (SCALARS, 4, 8, 10, 1, True, 3),
        (SCALARS, 2, 9, 7, 0, False, 1),
    ],
)
def test_outputs_and_gradients_match_the_dense_convolution(inputs, fields, height, width, padding, pool, batch, dtype):
    pair = layers(inputs, fields, padding, dtype)
    images = images_for(pair[0], batch, height, width)
    results = []
    for layer in pair:
        given = images.clone().requires_grad_(isinstance(inputs, int))
        out = layer(given, pool)
        out.backward(torch.linspace(-1, 1, out.numel(), dtype=dtype).view(out.shape).cos())
        results.append([out.detach(), layer.weight.grad, layer.bias.grad, given.grad])
    assert is_fast(pair[1], images, pool)
    for expected, actual in zip(*results, strict=True):
        if expected is not None:
            assert_near(actual, expected)


@pytest.mark.parametrize("pool", [False, True])
def test_the_layer_is_equivariant(pool):
    _, layer = layers(2, 3, 1)
    images = images_for(layer)
    expected = layer(images, pool).unflatten(1, (D4.size, -1))
    for element in range(D4.size):
        actual = layer(transform(images, element), pool).unflatten(1, (D4.size, -1))
        assert_near(actual, transform(expected.flatten(1, 2), element).unflatten(1, (D4.size, -1)))


def transform(images, element):
    """Transform fields (B, 8 n, H, W) by an element of D4; rows are x and columns y."""
    blocks = images.unflatten(1, (D4.size, -1))[:, D4.quotient[element]].flatten(1, 2)
    blocks = blocks.flip(-1) if D4.reflects(element) else blocks
    return blocks.rot90(element % D4.rotations, (-2, -1))


def test_unsupported_inputs_fall_back_to_the_dense_convolution():
    dense, fast = layers(2, 2, 1)
    images = images_for(fast)
    assert is_fast(fast, images, pool=True)
    cases = {
        "odd": (dense, fast, images[..., :7, :], True),
        "too wide": (dense, fast, images_for(fast, 1, 2, 600), False),
        "empty": (dense, fast, images[:0], False),
        "C4": (*layers(2, 2, 1, group=make_group("C4")), images[:, :8], True),
        "D8": (*layers(1, 2, 1, group=make_group("D8")), images, True),
        "vectors": (*layers(VECTORS, 2, 1), images[:, :2], True),
        "half": (*(copy.deepcopy(layer).bfloat16() for layer in (dense, fast)), images.bfloat16(), True),
    }
    for name, (expected, layer, given, pool) in cases.items():
        assert not is_fast(layer, given, pool), name
        torch.testing.assert_close(layer(given, pool), expected(given, pool), msg=name)


def test_scalars_that_need_a_gradient_get_one():
    dense, fast = layers(SCALARS, 2, 1)
    given = [images_for(fast).requires_grad_() for _ in range(1)] * 2
    gradients = [
        torch.autograd.grad(layer(images, True).sum(), images)[0]
        for layer, images in zip((dense, fast), given, strict=True)
    ]
    assert_near(gradients[1], gradients[0])
    with torch.no_grad():
        assert is_fast(fast, given[0])


def test_autocast_falls_back_to_the_dense_convolution():
    dense, fast = layers(2, 2, 1, torch.float32)
    images = images_for(fast)
    with torch.autocast("cpu", torch.bfloat16):
        assert not is_fast(fast, images)
        torch.testing.assert_close(fast(images), dense(images))


def test_full_filters_fall_back_to_the_dense_convolution():
    layer = FourierConv2d(D4, 1, 1, 1, full=True)
    assert not is_fast(layer, images_for(layer))


def test_mismatched_dtypes_raise_as_in_the_dense_convolution():
    _, fast = layers(2, 2, 1)
    with pytest.raises(RuntimeError, match="type"):
        fast(images_for(fast).float())


def test_changed_weights_take_effect():
    dense, fast = layers(2, 2, 1)
    images = images_for(fast)
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            before = fast(images)
            assert torch.equal(fast(images), before)
        with torch.no_grad():
            for layer in (dense, fast):
                layer.weight.mul_(2)
        with mode():
            assert_near(fast(images), dense(images))
        other = layers(2, 2, 1)[0]
        torch.nn.init.normal_(other.weight)
        for layer in (dense, fast):
            layer.load_state_dict(other.state_dict())
        with mode():
            assert_near(fast(images), dense(images))
    fast(images).sum().backward()
    assert fast.weight.grad is not None


def test_layers_can_be_copied_pickled_and_cast():
    dense, fast = layers(2, 2, 1, torch.float32)
    images = images_for(fast)
    assert list(fast.state_dict()) == list(dense.state_dict())
    with torch.no_grad():
        expected = fast(images)
        for twin in (copy.deepcopy(fast), pickle.loads(pickle.dumps(fast))):
            assert torch.equal(twin(images), expected)
        assert_near(fast.double()(images.double()), dense.double()(images.double()))


def test_concurrent_python_threads_get_the_same_results():
    pairs = [layers(2, fields, 1) for fields in (2, 3)]
    images = [images_for(pair[0], batch=4, height=32, width=32) for pair in pairs]
    expected = [fast(given, True) for (_, fast), given in zip(pairs, images, strict=True)]
    with ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(2,)) as pool:
        for _ in range(10):
            jobs = [pool.submit(fast, given, True) for (_, fast), given in zip(pairs, images, strict=True)]
            assert all(torch.equal(job.result(), out) for job, out in zip(jobs, expected, strict=True))
        assert pool.submit(torch.get_num_threads).result() == 2


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_processes_start_new_threads():
    assert sum(map(len, square_in_threads())) == 4
    with multiprocessing.get_context("fork").Pool(1) as pool:
        actual = pool.apply_async(square_in_threads).get(timeout=60)
    assert sorted(chain.from_iterable(actual)) == [0, 1, 4, 9]


@pytest.mark.skipif(not torch.backends.mkl.is_available(), reason="this PyTorch has no MKL")
def test_matrix_products_in_a_worker_thread_start_no_further_threads():
    """MKL's number of threads is the process's: with two workers there were four threads on two cores."""
    actual = in_threads(lambda results, _: results.append(mkl_threads()), range(2), list)
    assert actual == [["1"], ["1"]]
    assert mkl_threads() == "2"


def mkl_threads():
    return re.search(r"mkl_get_max_threads\(\) : (\d+)", torch.__config__.parallel_info()).group(1)


def square_in_threads():
    return in_threads(lambda results, task: results.append(task**2), range(4), list)


def test_blocks_cover_every_pixel_once_and_split_a_single_image():
    for batch, side, pool in [(1, 64, True), (1, 6, False), (7, 8, True), (2, 128, True), (5, 3, False)]:
        plan = Plan(torch.empty(batch, 32, side, side), D4.size, 4, 1, pool)
        covered = np.zeros((batch, side), int)
        for first, count, row, rows in chain.from_iterable(plan.blocks()):
            assert not (pool and (row % 2 or rows % 2))
            covered[first : first + count, row : row + rows] += 1
        assert (covered == 1).all()
        assert side < 8 or len(list(chain.from_iterable(plan.blocks()))) > 1
