"""Numba kernels of the D4 convolution in the Fourier domain: from pixels to coefficients of irreps and back.

A regular field is 8 numbers per pixel, one per element of D4. Its Fourier transform over the group has four
coefficients of irreps of dimension 1 (signed sums; irrep 2 a + m changes sign under a quarter turn if a, under a
reflection if m) and a 2 x 2 matrix of coefficients of the irrep of dimension 2, whose columns are vectors (x, y).
`expand` transforms every pixel and filters the coefficients with the six steerable functions. Products of irreps
decompose into irreps again, so that the results sort into 6 coefficients for each irrep of dimension 1 and 12 vectors
for the irrep of dimension 2. There the convolution is one matrix product per irrep of dimension 1, and one for both
components of the vectors. `collect` transforms the products back to pixels. `gather` and `spread` are the transposes of
`expand` and `collect`.

The pixels of a block, (row, column, image) with the image innermost, are the contiguous axis of every buffer. Strides
between the rows of buffers are constants and indices are unsigned, else LLVM does not vectorise. Buffers are flat:

    planes (8, PLANE): a block of one field with its border; a plane per group element or coefficient
    taps (9, PLANE): contributions of a row of pixels to each of its neighbours
    dim1 (fields, 6, 4, STRIDE): coefficients of irreps of dimension 1 that `expand` writes; (4, 4) for a scalar
    dim2 (fields, 12, 2, STRIDE): vectors of the irrep of dimension 2 that `expand` writes; (1, 2) for a scalar
    out_dim1 (fields, 4, STRIDE), out_dim2 (fields, 2, 2, STRIDE): products, matrices column by column
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

ORDER = 8  # of D4
PIXELS = 512  # of a block at most
STRIDE = PIXELS + 16  # an odd number of cache lines, so that rows do not evict each other
PLANE = 1040  # 512 pixels with their border, in rows of up to 256
FASTMATH = {"reassoc", "contract", "nsz"}  # not nnan: NaN must propagate
S, P, C, ONE, TWO = (np.uintp(k) for k in (STRIDE, PLANE, 4 * STRIDE, 1, 2))


def compiled(function: Callable[..., None]) -> Callable[..., None]:
    """Compile a kernel; cache the machine code on disk if a writable folder exists."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": FASTMATH}
    try:
        return njit(function, cache=True, **options)
    except RuntimeError:  # no writable folder
        return njit(function, **options)


@njit(inline="always")
def _analyse(values):  # type: ignore[no-untyped-def]
    """Return the Fourier transform over D4: four coefficients of dimension 1, then the 2 x 2 matrix row by row.

    `values` has the four rotations (a) first, then the four reflections (b).
    """
    a0, a1, a2, a3, b0, b1, b2, b3 = values
    p, q, r, s = a0 - a2, a1 - a3, b0 - b2, b1 - b3
    a, alternating_a = (a0 + a2) + (a1 + a3), (a0 + a2) - (a1 + a3)
    b, alternating_b = (b0 + b2) + (b1 + b3), (b0 + b2) - (b1 + b3)
    return a + b, a - b, alternating_a + alternating_b, alternating_a - alternating_b, p + r, s - q, q + s, p - r


@njit(inline="always")
def _synthesise(values):  # type: ignore[no-untyped-def]
    """Return the transpose of `_analyse`."""
    d0, d1, d2, d3, e00, e01, e10, e11 = values
    p, r, q, s = e00 + e11, e00 - e11, e10 - e01, e10 + e01
    a_even, a_odd = (d0 + d1) + (d2 + d3), (d0 + d1) - (d2 + d3)
    b_even, b_odd = (d0 - d1) + (d2 - d3), (d0 - d1) - (d2 - d3)
    return a_even + p, a_odd + q, a_even - p, a_odd - q, b_even + r, b_odd + s, b_even - r, b_odd - s


@njit(inline="always")
def _get(planes, i):  # type: ignore[no-untyped-def]
    j = i + P + P + P + P
    first = planes[i], planes[i + P], planes[i + P + P], planes[i + P + P + P]
    return (*first, planes[j], planes[j + P], planes[j + P + P], planes[j + P + P + P])


@njit(inline="always")
def _put(planes, i, v):  # type: ignore[no-untyped-def]
    j = i + P + P + P + P
    planes[i], planes[i + P], planes[i + P + P], planes[i + P + P + P] = v[0], v[1], v[2], v[3]
    planes[j], planes[j + P], planes[j + P + P], planes[j + P + P + P] = v[4], v[5], v[6], v[7]


@njit(inline="always")
def _filter(planes, up, pitch, step, values):  # type: ignore[no-untyped-def]
    """Return the six steerable functions at the pixel whose upper left neighbour is `up`: four even ones, then x, y."""
    centre, edge, corner, axis, diagonal, cross, saddle = values
    here, down, far = up + pitch, up + pitch + pitch, step + step
    nw, n_, ne = planes[up], planes[up + step], planes[up + far]
    w_, middle, e_ = planes[here], planes[here + step], planes[here + far]
    sw, s_, se = planes[down], planes[down + step], planes[down + far]
    ring = edge * ((n_ + s_) + (w_ + e_)) + corner * ((nw + ne) + (sw + se))
    x = axis * (s_ - n_) + diagonal * ((sw + se) - (nw + ne))
    y = axis * (e_ - w_) + diagonal * ((ne + se) - (nw + sw))
    return centre * middle, ring, cross * ((n_ + s_) - (w_ + e_)), saddle * ((nw + se) - (ne + sw)), x, y


@njit(inline="always")
def _vector(irrep, x, y):  # type: ignore[no-untyped-def]
    """Return the product of irrep `irrep` of dimension 1 with the vector (x, y), a vector."""
    first, second = (y, x) if irrep % 2 else (x, y)
    return first, -second if irrep == 1 or irrep == 2 else second


@njit(inline="always")
def _vector_transposed(irrep, first, second):  # type: ignore[no-untyped-def]
    signed = -second if irrep == 1 or irrep == 2 else second
    return (signed, first) if irrep % 2 else (first, signed)


@compiled
def expand(images, first, count, row, rows, padding, values, planes, dim1, dim2):  # type: ignore[no-untyped-def]
    """Transform and filter the rows `row` to `row + rows` of the images `first` to `first + count`.

    Images are (B, 8, fields, H, W), or (B, 1, channels, H, W) for scalars, which have the trivial irrep only.
    """
    elements, fields, height, width = images.shape[1:]
    step, columns = np.uintp(count), np.uintp(width + 2 * padding - 2)
    across, pitch = columns * step, (columns + TWO) * step
    used = np.uintp(rows + 2) * pitch
    functions, vectors, even = (6, 12, 8) if elements == ORDER else (4, 1, 0)
    planes[:] = 0
    for field in range(fields):
        for image in range(count):
            for element in range(elements):
                for r in range(max(padding - row, 0), min(rows + 2, height + padding - row)):
                    to = np.uintp(element) * P + np.uintp(r) * pitch + np.uintp(padding) * step + np.uintp(image)
                    source = images[first + image, element, field, row + r - padding]
                    for k in range(width):
                        planes[to + np.uintp(k) * step] = source[k]
        if elements == ORDER:
            for pixel in range(used):
                _put(planes, pixel, _analyse(_get(planes, pixel)))
        for irrep in range(4):
            at, to = np.uintp(4 * functions * field + irrep) * S, np.uintp(2 * (vectors * field + even + irrep)) * S
            plane, cross, saddle = np.uintp(irrep) * P, np.uintp(irrep ^ 2) * P, np.uintp(irrep ^ 3) * P
            for pixel_row in range(np.uintp(rows)):
                for k in range(across):
                    i, j = at + pixel_row * across + k, pixel_row * pitch + k
                    v = _filter(planes, plane + j, pitch, step, values)
                    dim1[i], dim1[i + C] = v[0], v[1]
                    dim1[i + C + C] = _filter(planes, cross + j, pitch, step, values)[2]
                    dim1[i + C + C + C] = _filter(planes, saddle + j, pitch, step, values)[3]
            if irrep == 0 or elements == ORDER:
                for pixel_row in range(np.uintp(rows)):
                    for k in range(across):
                        i = to + pixel_row * across + k
                        v = _filter(planes, plane + pixel_row * pitch + k, pitch, step, values)
                        dim2[i], dim2[i + S] = _vector(irrep, v[4], v[5])
        if elements == 1:
            continue
        for column in range(2):  # of the 2 x 2 matrix
            upper = np.uintp(4 + column) * P
            at, to = np.uintp(24 * field + 16 + 4 * column) * S, np.uintp(24 * field + 2 * column) * S
            for pixel_row in range(np.uintp(rows)):
                for k in range(across):
                    i = pixel_row * across + k
                    u = _filter(planes, upper + pixel_row * pitch + k, pitch, step, values)
                    v = _filter(planes, upper + TWO * P + pixel_row * pitch + k, pitch, step, values)
                    _put_dim2(dim2, to + i, (u[0], v[0], u[1], v[1], u[2], -v[2], v[3], u[3]))
                    j = at + i
                    dim1[j], dim1[j + TWO * S] = u[4] + v[5], u[4] - v[5]
                    dim1[j + S], dim1[j + TWO * S + S] = v[4] - u[5], v[4] + u[5]


@njit(inline="always")
def _put_dim2(dim2, i, v):  # type: ignore[no-untyped-def]
    j = i + np.uintp(8) * S
    dim2[i], dim2[i + S], dim2[i + np.uintp(4) * S], dim2[i + np.uintp(5) * S] = v[0], v[1], v[2], v[3]
    dim2[j], dim2[j + S], dim2[j + np.uintp(4) * S], dim2[j + np.uintp(5) * S] = v[4], v[5], v[6], v[7]


@njit(inline="always")
def _tap(taps, i, step, values, v):  # type: ignore[no-untyped-def]
    """Write a pixel's contributions to its neighbours: the transpose of `_filter`."""
    centre, edge, corner, axis, diagonal, cross, saddle = values
    edges, corners, even, odd = edge * v[1], corner * v[1], cross * v[2], saddle * v[3]
    x, y, x_diagonal, y_diagonal = axis * v[4], axis * v[5], diagonal * v[4], diagonal * v[5]
    j, k = i + P + P + P, i + np.uintp(6) * P
    one, two = P + step, P + P + step + step
    taps[i], taps[i + one] = (corners + odd) - (x_diagonal + y_diagonal), (edges + even) - x
    taps[i + two], taps[j] = (corners - odd) + (y_diagonal - x_diagonal), (edges - even) - y
    taps[j + one], taps[j + two] = centre * v[0], (edges - even) + y
    taps[k], taps[k + one] = (corners - odd) + (x_diagonal - y_diagonal), (edges + even) + x
    taps[k + two] = (corners + odd) + (x_diagonal + y_diagonal)


@njit(inline="always")
def _add_taps(taps, planes, up, pitch):  # type: ignore[no-untyped-def]
    for neighbour in range(3):
        i, to = np.uintp(3 * neighbour) * P, up + np.uintp(neighbour) * pitch
        for k in range(pitch):
            planes[to + k] += taps[i + k] + taps[i + P + k] + taps[i + P + P + k]


@compiled
def gather(dim1, dim2, first, count, row, rows, padding, values, taps, planes, images):  # type: ignore[no-untyped-def]
    """Add the transpose of `expand`, applied to `dim1` and `dim2`, to `images` (B, 8, fields, H, W)."""
    _, elements, fields, height, width = images.shape
    step, columns = np.uintp(count), np.uintp(width + 2 * padding - 2)
    across, pitch = columns * step, (columns + TWO) * step
    used = np.uintp(rows + 2) * pitch
    taps[:] = 0  # the border beside a row stays 0
    for field in range(fields):
        planes[:] = 0
        for irrep in range(4):
            dim1_start, vector = np.uintp(24 * field) * S, np.uintp(24 * field + 16 + 2 * irrep) * S
            centre, cross = dim1_start + np.uintp(irrep) * S, dim1_start + C + C + np.uintp(irrep ^ 2) * S
            saddle = dim1_start + C + C + C + np.uintp(irrep ^ 3) * S
            for pixel_row in range(np.uintp(rows)):
                for k in range(across):
                    i = pixel_row * across + k
                    x, y = _vector_transposed(irrep, dim2[vector + i], dim2[vector + i + S])
                    _tap(
                        taps,
                        k,
                        step,
                        values,
                        (dim1[centre + i], dim1[centre + i + C], dim1[cross + i], dim1[saddle + i], x, y),
                    )
                _add_taps(taps, planes, np.uintp(irrep) * P + pixel_row * pitch, pitch)
        for column in range(2):
            upper = np.uintp(4 + column) * P
            at, to = np.uintp(24 * field + 16 + 4 * column) * S, np.uintp(24 * field + 2 * column) * S
            for pixel_row in range(np.uintp(rows)):
                for k in range(across):
                    i, j = at + pixel_row * across + k, to + pixel_row * across + k
                    x, y = dim1[i] + dim1[i + TWO * S], dim1[i + TWO * S + S] - dim1[i + S]
                    even = dim2[j], dim2[j + np.uintp(4) * S], dim2[j + np.uintp(8) * S]
                    _tap(taps, k, step, values, even + (dim2[j + np.uintp(13) * S], x, y))
                _add_taps(taps, planes, upper + pixel_row * pitch, pitch)
                for k in range(across):
                    i, j = at + pixel_row * across + k, to + pixel_row * across + k + S
                    x, y = dim1[i + S] + dim1[i + TWO * S + S], dim1[i] - dim1[i + TWO * S]
                    even = dim2[j], dim2[j + np.uintp(4) * S], -dim2[j + np.uintp(8) * S]
                    _tap(taps, k, step, values, even + (dim2[j + np.uintp(11) * S], x, y))
                _add_taps(taps, planes, upper + TWO * P + pixel_row * pitch, pitch)
        for pixel in range(used):
            _put(planes, pixel, _synthesise(_get(planes, pixel)))
        for image in range(count):
            for element in range(elements):
                for r in range(max(padding - row, 0), min(rows + 2, height + padding - row)):
                    at = np.uintp(element) * P + np.uintp(r) * pitch + np.uintp(padding) * step + np.uintp(image)
                    target = images[first + image, element, field, row + r - padding]
                    for k in range(width):
                        target[k] += planes[at + np.uintp(k) * step]


@compiled
def collect(out_dim1, out_dim2, bias, first, count, row, rows, columns, planes, pool, out, chosen):  # type: ignore[no-untyped-def]
    """Transform products of a block (see `expand`) into pixels of `out` (B, 8, fields, H', W').

    If `pool`, apply 2 x 2 max pooling and ReLU; `chosen` (uint8, same shape) gets the index of the maximum, 4 for none.
    """
    step, used = np.uintp(count), np.uintp(rows * columns * count)
    for field in range(len(bias)):
        at = np.uintp(4 * field) * S
        for pixel in range(used):
            j = at + pixel
            d = out_dim1[j], out_dim1[j + S], out_dim1[j + TWO * S], out_dim1[j + TWO * S + S]
            e = out_dim2[j], out_dim2[j + TWO * S], out_dim2[j + S], out_dim2[j + TWO * S + S]
            _put(planes, pixel, _synthesise((d[0] + bias[field], d[1], d[2], d[3], *e)))
        for image in range(count):
            for element in range(ORDER):
                at = np.uintp(element) * P + np.uintp(image)
                if not pool:
                    for r in range(rows):
                        target = out[first + image, element, field, row + r]
                        for k in range(columns):
                            target[k] = planes[at + np.uintp(r * columns + k) * step]
                    continue
                for r in range(rows // 2):
                    target = out[first + image, element, field, row // 2 + r]
                    which = chosen[first + image, element, field, row // 2 + r]
                    if count == 1:
                        _pool(planes, at + np.uintp(2 * r * columns), ONE, np.uintp(columns), target, which)
                    else:
                        _pool(planes, at + np.uintp(2 * r * columns) * step, step, np.uintp(columns), target, which)


@njit(inline="always")
def _pool(planes, at, step, columns, out, chosen):  # type: ignore[no-untyped-def]
    for k in range(columns // TWO):
        i = at + TWO * k * step
        j = i + columns * step
        p, q, r, s = planes[i], planes[i + step], planes[j], planes[j + step]
        top, bottom = max(p, q), max(r, s)
        best = max(top, bottom)
        position = (q > p) if top >= bottom else 2 + (s > r)
        out[k] = 0 if best <= 0 else best
        chosen[k] = 4 if best <= 0 else position


@njit(inline="always")
def _unpool(gradient, chosen, left, planes, at, step):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(len(gradient))):
        i = at + TWO * k * step
        planes[i] = gradient[k] if chosen[k] == left else 0
        planes[i + step] = gradient[k] if chosen[k] == np.uint8(left + 1) else 0


@compiled
def spread(gradient, chosen, pool, first, count, row, rows, columns, planes, out_dim1, out_dim2):  # type: ignore[no-untyped-def]
    """Write the transpose of `collect`, applied to `gradient`, to `out_dim1` and `out_dim2`."""
    step, used = np.uintp(count), np.uintp(rows * columns * count)
    for field in range(gradient.shape[2]):
        for image in range(count):
            for element in range(ORDER):
                to = np.uintp(element) * P + np.uintp(image)
                for r in range(rows):
                    i = to + np.uintp(r * columns) * step
                    if pool:
                        source = gradient[first + image, element, field, (row + r) // 2]
                        which = chosen[first + image, element, field, (row + r) // 2]
                        if count == 1:
                            _unpool(source, which, np.uint8(2 * (r % 2)), planes, i, ONE)
                        else:
                            _unpool(source, which, np.uint8(2 * (r % 2)), planes, i, step)
                    else:
                        source = gradient[first + image, element, field, row + r]
                        for k in range(columns):
                            planes[i + np.uintp(k) * step] = source[k]
        at = np.uintp(4 * field) * S
        for pixel in range(used):
            j, v = at + pixel, _analyse(_get(planes, pixel))
            out_dim1[j], out_dim1[j + S], out_dim1[j + TWO * S], out_dim1[j + TWO * S + S] = v[0], v[1], v[2], v[3]
            out_dim2[j], out_dim2[j + TWO * S] = v[4], v[5]
            out_dim2[j + S], out_dim2[j + TWO * S + S] = v[6], v[7]
