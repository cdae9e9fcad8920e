"""The values of a group of shifted points, summed over a block of shifts: what `score_field` spends
its time in.

A kernel for each number of cells that can be nearest in the block (`Near.alive`), unrolled, so that
the loop over the points runs on vectors without a branch. Arguments are those tables of
`score_field.Near` and `score_field.Lanes` that have their names; `i0` and `j0` are the first shift
of the block, and `total` receives the sums.
"""

import numpy as np

from tilestream.kernels.cache import njit

GROUP = 32
"""Points of a group; their values sum to less than 2^31."""
BLOCK = 3
"""Shifts along each side of a block."""
CAP = np.float32(31.0)
"""Largest exponent; the value is 0 there."""
ONE = 2.0**24
"""The value 1 as a whole number."""
P0, P1, P2 = (np.float32(c * ONE) for c in (0.9999999250634845, -0.693142252591582, 0.240172189236))
P3, P4, P5 = (np.float32(c * ONE) for c in (-0.0552797225485, 0.00918861169470, -0.000938788322664))
"""2^-f on [0, 1], relative error 8e-8 (least squares, reweighted towards equal errors)."""


@njit(nogil=True, error_model="numpy", inline="always")
def _value(exponent):  # type: ignore[no-untyped-def]
    """2^-exponent as a whole number of 2^-24, for exponents from 0 to `CAP`, rounded down."""
    whole = np.int32(exponent)
    f = exponent - np.float32(whole)
    one = np.int32(P0 + f * (P1 + f * (P2 + f * (P3 + f * (P4 + f * P5)))))
    return np.int32(one >> (whole & 31))


@njit(nogil=True, error_model="numpy", inline="always")
def _at_shift(slope, k, i, j):  # type: ignore[no-untyped-def]
    """T, G1.v and G2.v of cell k at the shift (i, j)."""
    return (
        np.int32(np.rint(i * slope[k, 0] + j * slope[k, 1])),
        np.float32(i * slope[k, 2] + j * slope[k, 3]),
        np.float32(i * slope[k, 4] + j * slope[k, 5]),
    )


@njit(nogil=True, error_model="numpy", inline="always")
def _limit(pull, limited, limit, p, i, j):  # type: ignore[no-untyped-def]
    """The distance from which on point p has no cell at the shift (i, j), in whole steps."""
    return np.int32(limit - np.int32(i * pull[limited, p]) - np.int32(j * pull[limited, p + GROUP]))


@njit(nogil=True, error_model="numpy", inline="always")
def _nearer(found, A, U, k, p, shift):  # type: ignore[no-untyped-def]
    """The distance and the exponent found so far for point p, or those of cell k."""
    least, exponent = found
    far = np.int32(A[k, p] + shift[0])
    u1, u2 = U[k, p] + shift[1], U[k, p + GROUP] + shift[2]
    here = u1 * u1 + u2 * u2 + U[k, p + 2 * GROUP]
    return min(far, least), here if far < least else exponent


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath={"contract"})
def sum_of_two(A, U, slope, alive, pull, base, limited, i0, j0, total):  # type: ignore[no-untyped-def]
    """Add the values of a group in a block of shifts where two cells are alive."""
    a, b = alive[0], alive[1]
    for s in range(BLOCK * BLOCK):
        i, j = i0 + s // BLOCK, j0 + s % BLOCK
        at_a = _at_shift(slope, a, i, j)
        at_b = _at_shift(slope, b, i, j)
        limit, i32, j32 = base[limited, i + 10, j + 10], np.int32(i), np.int32(j)
        values = np.int32(0)
        for p in range(GROUP):
            found = _limit(pull, limited, limit, p, i32, j32), CAP
            found = _nearer(found, A, U, a, p, at_a)
            found = _nearer(found, A, U, b, p, at_b)
            values = np.int32(values + _value(min(found[1], CAP)))
        total[i + 10, j + 10] += values


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath={"contract"})
def sum_of_four(A, U, slope, alive, pull, base, limited, i0, j0, total):  # type: ignore[no-untyped-def]
    """Add the values of a group in a block of shifts where four cells are alive."""
    a, b, c, d = alive[0], alive[1], alive[2], alive[3]
    for s in range(BLOCK * BLOCK):
        i, j = i0 + s // BLOCK, j0 + s % BLOCK
        at_a = _at_shift(slope, a, i, j)
        at_b = _at_shift(slope, b, i, j)
        at_c = _at_shift(slope, c, i, j)
        at_d = _at_shift(slope, d, i, j)
        limit, i32, j32 = base[limited, i + 10, j + 10], np.int32(i), np.int32(j)
        values = np.int32(0)
        for p in range(GROUP):
            found = _limit(pull, limited, limit, p, i32, j32), CAP
            found = _nearer(found, A, U, a, p, at_a)
            found = _nearer(found, A, U, b, p, at_b)
            found = _nearer(found, A, U, c, p, at_c)
            found = _nearer(found, A, U, d, p, at_d)
            values = np.int32(values + _value(min(found[1], CAP)))
        total[i + 10, j + 10] += values


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath={"contract"})
def sum_of_eight(A, U, slope, alive, pull, base, limited, i0, j0, total):  # type: ignore[no-untyped-def]
    """Add the values of a group in a block of shifts where eight cells are alive."""
    a, b, c, d = alive[0], alive[1], alive[2], alive[3]
    e, f, g, h = alive[4], alive[5], alive[6], alive[7]
    for s in range(BLOCK * BLOCK):
        i, j = i0 + s // BLOCK, j0 + s % BLOCK
        at_a = _at_shift(slope, a, i, j)
        at_b = _at_shift(slope, b, i, j)
        at_c = _at_shift(slope, c, i, j)
        at_d = _at_shift(slope, d, i, j)
        at_e = _at_shift(slope, e, i, j)
        at_f = _at_shift(slope, f, i, j)
        at_g = _at_shift(slope, g, i, j)
        at_h = _at_shift(slope, h, i, j)
        limit, i32, j32 = base[limited, i + 10, j + 10], np.int32(i), np.int32(j)
        values = np.int32(0)
        for p in range(GROUP):
            found = _limit(pull, limited, limit, p, i32, j32), CAP
            found = _nearer(found, A, U, a, p, at_a)
            found = _nearer(found, A, U, b, p, at_b)
            found = _nearer(found, A, U, c, p, at_c)
            found = _nearer(found, A, U, d, p, at_d)
            found = _nearer(found, A, U, e, p, at_e)
            found = _nearer(found, A, U, f, p, at_f)
            found = _nearer(found, A, U, g, p, at_g)
            found = _nearer(found, A, U, h, p, at_h)
            values = np.int32(values + _value(min(found[1], CAP)))
        total[i + 10, j + 10] += values


@njit(nogil=True, error_model="numpy", boundscheck=False, fastmath={"contract"})
def sum_of_many(A, U, slope, alive, count, pull, base, limited, i0, j0, total, least, exponent):  # type: ignore[no-untyped-def]
    """Add the values of a group where more cells are alive: first find each point's distance."""
    for s in range(BLOCK * BLOCK):
        i, j = i0 + s // BLOCK, j0 + s % BLOCK
        limit, i32, j32 = base[limited, i + 10, j + 10], np.int32(i), np.int32(j)
        for p in range(GROUP):
            least[p] = _limit(pull, limited, limit, p, i32, j32)
            exponent[p] = CAP
        for n in range(count):
            k = alive[n]
            shift = _at_shift(slope, k, i, j)[0]
            for p in range(GROUP):
                least[p] = min(least[p], np.int32(A[k, p] + shift))
        for n in range(count):
            k = alive[n]
            at_k = _at_shift(slope, k, i, j)
            for p in range(GROUP):
                # Only the nearest cell itself is within one step beyond its distance.
                found = np.int32(least[p] + 1), exponent[p]
                exponent[p] = _nearer(found, A, U, k, p, at_k)[1]
        values = np.int32(0)
        for p in range(GROUP):
            values = np.int32(values + _value(min(exponent[p], CAP)))
        total[i + 10, j + 10] += values
