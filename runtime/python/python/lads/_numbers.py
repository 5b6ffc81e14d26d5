"""Checks numbers and lists that callers give: what is wrong is a typed exception that names the argument; the native half calls this module too.

A bool is no number here: where a count is expected it is a mistake.
"""

import math
import operator

import numpy as np

from .errors import EvaluationError, InputError

MOST = 10**9  # episodes, processes: more is a mistake
SEED = 2**64 - 1


def whole(name, value, least=0, most=None, error=InputError):
    """Returns a whole number from `least` to `most`; another one is an `error`, another type a TypeError."""
    number = None
    if not isinstance(value, (bool, np.bool_, np.ndarray)):
        try:
            number = operator.index(value)
        except TypeError:
            pass
    if number is None:
        raise TypeError(f"{name}: it is a {type(value).__name__}; give a whole number")
    if number < least or (most is not None and number > most):
        wanted = f"{least} or more" if number < least else f"{most} or less"
        raise error(f"{name} is {_shown(number)}; give {wanted}")
    return number


def real(name, value, error=InputError):
    """Returns a finite number above 0 as a float; another one is an `error`, another type a TypeError."""
    if isinstance(value, (str, bytes, bool, np.bool_, np.ndarray)):
        raise TypeError(f"{name}: it is a {type(value).__name__}; give a number")
    try:
        number = float(value)
    except TypeError:
        raise TypeError(f"{name}: it is a {type(value).__name__}; give a number") from None
    except OverflowError:
        number = math.inf
    if not 0 < number < math.inf:
        raise error(f"{name}: it has to be a positive number, not {number}; give a finite one above 0")
    return number


def rows(given, count):
    """Returns the numbers of a batch's rows, given as a list, a tuple, a range or an array of whole numbers."""
    if isinstance(given, (str, bytes, dict)) or not hasattr(given, "__len__") or getattr(given, "ndim", 1) != 1:
        raise TypeError(f"rows: it is a {type(given).__name__}; give a list of row numbers")
    found = [whole("rows", row, least=-(2**63), most=2**63) for row in given]
    wrong = [row for row in found if not 0 <= row < count]
    if wrong:
        raise InputError(f"row {wrong[0]}: the batch has {count}; give rows from 0 on")
    return found


def names(name, given, error=EvaluationError):
    """Returns a sequence of names as a tuple; a single text is an `error`, for its letters would be the names."""
    if isinstance(given, (str, bytes)):
        raise error(f"{name}: it is one text, {_cut(repr(given))}; give a list of names")
    try:
        return tuple(given)
    except TypeError:
        raise TypeError(f"{name}: it is a {type(given).__name__}; give a list of names") from None


def callables(**given):
    """Refuses an argument that is neither callable nor None."""
    for name, value in given.items():
        if value is not None and not callable(value):
            raise TypeError(f"{name}: it is a {type(value).__name__}; give a callable")


def instance(name, value, kind, remedy):
    """Refuses an object that is not of a class."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: it is a {type(value).__name__}; give {remedy}")


def _shown(number):
    # Python refuses to write very long ones.
    return str(number) if number.bit_length() <= 128 else f"a {'negative ' * (number < 0)}number of {number.bit_length()} bits"


def _cut(text):
    return text if len(text) <= 60 else text[:60] + "…"
