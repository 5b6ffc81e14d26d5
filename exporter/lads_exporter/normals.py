"""Draws standard normal random numbers with the same bits as the runtime: runtime/core/src/normal.rs in numpy.

PCG64 gives 52 bits k, these the uniform number u = (2k + 1) / 2^53, and the inverse of the normal distribution function (Wichura's
AS 241, PPND16) the result, rounded to float32. Every step is an operation of float64 that IEEE 754 rounds correctly, in the
order of the runtime's, so that a policy in PyTorch and its compiled program denoise the same noise. The table that both are
tested against is runtime/core/tests/normals.txt.
"""

import operator

import numpy as np

MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
STREAM = 0x243F6A8885A308D313198A2E03707344

# Coefficients of AS 241, of the highest power first: |u - 1/2| up to 0.425, then root up to 5, then beyond.
CENTRAL = (
    (2.5090809287301226727e+3, 3.3430575583588128105e+4, 6.7265770927008700853e+4, 4.5921953931549871457e+4,
     1.3731693765509461125e+4, 1.9715909503065514427e+3, 1.3314166789178437745e+2, 3.3871328727963666080e+0),
    (5.2264952788528545610e+3, 2.8729085735721942674e+4, 3.9307895800092710610e+4, 2.1213794301586595867e+4,
     5.3941960214247511077e+3, 6.8718700749205790830e+2, 4.2313330701600911252e+1, 1.0),
)
MIDDLE = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1, 1.27045825245236838258e+0,
     3.64784832476320460504e+0, 5.76949722146069140550e+0, 4.63033784615654529590e+0, 1.42343711074968357734e+0),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2, 1.48103976427480074590e-1,
     6.89767334985100004550e-1, 1.67638483018380384940e+0, 2.05319162663775882187e+0, 1.0),
)
FAR = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3, 2.65321895265761230930e-2,
     2.96560571828504891230e-1, 1.78482653991729133580e+0, 5.46378491116411436990e+0, 6.65790464350110377720e+0),
    (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5, 7.86869131145613259100e-4,
     1.48753612908506148525e-2, 1.36929880922735805310e-1, 5.99832206555887937690e-1, 1.0),
)


def ln(x):
    """Computes the natural logarithm of normal positive float64, within one unit in the last place: FreeBSD's e_log.c (Sun
    Microsystems)."""
    one, root_half = np.uint64(0x3FF << 52), np.uint64(0x3FE6A09E << 32)
    shifted = x.view(np.uint64) + (one - root_half)
    k = (shifted >> np.uint64(52)).astype(np.float64) - 1023
    f = ((shifted & np.uint64((1 << 52) - 1)) + root_half).view(np.float64) - 1.0
    half_square = 0.5 * f * f
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    even = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    odd = z * (6.666666666666735130e-01
               + w * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)))
    return (s * (half_square + (odd + even)) + k * 1.90821492927058770002e-10 - half_square + f
            + k * 6.93147180369123816490e-01)


def _polynomial(x, coefficients):
    value = np.zeros_like(x)
    for coefficient in coefficients:
        value = value * x + coefficient
    return value


def quantile(u):
    """Computes the float64 below which a standard normal number lies with probability u [N], multiples of 2^-53 between 0 and 1."""
    q = u - 0.5
    root = np.sqrt(-ln(np.where(q < 0.0, u, 1.0 - u)))
    sign = np.copysign(1.0, q)

    def quotient(x, factor, coefficients):
        above, below = coefficients
        # Where a range does not apply, its quotient is not used and may be anything.
        with np.errstate(all="ignore"):
            return _polynomial(x, above) * factor / _polynomial(x, below)

    central = quotient(0.180625 - q * q, q, CENTRAL)
    tail = np.where(root > 5.0, quotient(root - 5.0, sign, FAR), quotient(root - 1.6, sign, MIDDLE))
    return np.where(np.abs(q) <= 0.425, central, tail)


class Normals:
    """Stream of the runtime's normals for a seed, 0 to 2^64 - 1, from its beginning."""

    def __init__(self, seed):
        # Not a number of numpy, whose arithmetic ends at 64 bits.
        seed = operator.index(seed)
        if not 0 <= seed < 1 << 64:
            raise ValueError(f"a seed is a whole number from 0 to 2^64 - 1, not {seed}")
        increment = (STREAM << 1 | 1) % (1 << 128)
        state = ((seed + increment) * MULTIPLIER + increment) % (1 << 128)
        self._bits = np.random.PCG64(0)
        self._bits.state = {
            "bit_generator": "PCG64", "state": {"state": state, "inc": increment}, "has_uint32": 0, "uinteger": 0,
        }

    def draw(self, *shape):
        """Draws the stream's next numbers, float32 of this shape, the last index fastest."""
        digits = self._bits.random_raw(int(np.prod(shape, dtype=int))) >> np.uint64(12)
        # As digits of a number in [1, 2), of which 1 - 2^-53 is taken away; the difference is exact.
        u = (np.uint64(0x3FF << 52) | digits).view(np.float64) - (1.0 - 2.0**-53)
        return quantile(u).astype(np.float32).reshape(shape)
