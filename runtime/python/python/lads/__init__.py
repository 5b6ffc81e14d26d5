"""Policies in Python, by the runtime that runs them in the machine.

`open` reads a policy, a bundle (.onnx) or a compiled image (.lads); `Policy.controller` puts it to work; `Controller.step` turns an
observation into an action. `lads.gym` evaluates a controller in any environment of Gymnasium's API, `lads.vector` steps many of them over
threads, and `verify` compares one with the policy that was trained. Whatever is refused is an exception of `lads.errors`.
"""

import os

from . import errors, gym, vector
from ._lads import Controller, Policy, Selected, StepReport, __version__, forked, from_image, open
from .contract import Channel, Context, Contract, Element, Golden, Instruction, Language, SelfTest
from .errors import LadsError
from .verification import Certificate, Reply, verify

# A controller that a fork has copied is refused in the child.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=forked)

__all__ = [
    "Certificate",
    "Channel",
    "Context",
    "Contract",
    "Controller",
    "Element",
    "Golden",
    "Instruction",
    "LadsError",
    "Language",
    "Policy",
    "Reply",
    "SelfTest",
    "Selected",
    "StepReport",
    "__version__",
    "errors",
    "from_image",
    "gym",
    "open",
    "vector",
    "verify",
]
