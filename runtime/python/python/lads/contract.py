"""What a policy expects and promises, as frozen dataclasses; read from the report of `Policy.inspect`, which never lacks a field."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

DTYPES = {"f32": np.dtype(np.float32), "u8": np.dtype(np.uint8), "i32": np.dtype(np.int32)}


@dataclass(frozen=True)
class Element:
    """One element of a channel. The physical value is `reference + offset + scale * value`."""

    name: str
    unit: str
    """Unit of the value, `1` for none."""
    min: float
    max: float
    joint: str
    """Joint that it belongs to; empty for none."""
    interface: str
    """What of the joint: position, velocity, effort; empty where the bundle does not say."""
    scale: float
    offset: float


@dataclass(frozen=True)
class Channel:
    """A value at the policy's edge: an observation, the action, the words of an instruction, noise, a demonstration."""

    name: str
    role: str
    """`observation`, `action`, `instruction`, `noise` or `demonstration`."""
    dtype: np.dtype
    shape: tuple[int, ...]
    elements: tuple[Element, ...]
    """In order; empty for images and the like, whose elements have no names."""
    min: float | None
    """Smallest value of every element where they have no names, otherwise None."""
    max: float | None
    quaternion_order: str
    """`none`, `wxyz` or `xyzw`."""
    reference: str


@dataclass(frozen=True)
class Instruction:
    """An instruction that the policy knows."""

    id: str
    text: str
    words: int
    """Length of its word embeddings."""


@dataclass(frozen=True)
class Language:
    """The language encoder that made the word embeddings."""

    encoder: str
    sha256: str
    dim: int
    """Elements of a word embedding."""
    acceptance: float
    """Similarity to a known instruction from which other sentences may be followed; above 1 where none may be."""


@dataclass(frozen=True)
class Context:
    """How much a policy remembers."""

    words: int
    """Words of the longest instruction; 0 for a policy that takes none."""
    steps: int | None
    """Control steps that it holds; None without such a bound."""
    beyond: str | None
    """What happens then: `restart` or `refuse`."""


@dataclass(frozen=True)
class Contract:
    """What a policy expects and promises."""

    family: str
    environment: str
    environment_version: str
    control_period: float
    """Seconds from one control step to the next."""
    channels: tuple[Channel, ...]
    indices: int
    """How many indices, such as those of latent plans, it selects from; 0 for a policy that selects nothing."""
    decision: str
    """How an index is picked: `argmax` or `sample`."""
    noise: str
    """Where noise comes from: `zero` or `seeded`."""
    noise_elements: int
    """Elements of noise that a control step takes at most."""
    context: Context
    language: Language | None
    instructions: tuple[Instruction, ...]
    bundle_sha256: str
    """SHA-256 of the bundle that the image was compiled from."""

    @property
    def observations(self) -> tuple[Channel, ...]:
        """The channels that are given in every control step."""
        return tuple(channel for channel in self.channels if channel.role == "observation")

    @property
    def action(self) -> Channel:
        """The channel that every control step writes."""
        return next(channel for channel in self.channels if channel.role == "action")


@dataclass(frozen=True, eq=False)
class Golden:
    """The recorded episode of the self-test."""

    instruction: str | None
    """Id of the instruction that was followed."""
    observations: dict[str, np.ndarray]
    """For every channel `[steps, *shape]`."""
    noise: np.ndarray
    """All draws of each step, `[steps, noise_elements]`."""
    selected: np.ndarray | None
    """The index in force in each step; None for a policy that selects nothing."""
    actions: np.ndarray
    """`[steps, actions]`, inside the limits."""
    tolerance: float
    """Largest difference of an action that the self-test accepts."""


@dataclass(frozen=True)
class SelfTest:
    """What a self-test that passed has measured."""

    steps: int
    largest_error: float
    """Largest absolute difference of an action element, in its unit."""
    tolerance: float
    digest: str
    """FNV-1a of 32 bits over all actions: two machines with the same digest computed the same bits."""


def read(report: str) -> Contract:
    """The contract in a report of `Policy.inspect`, given as JSON."""
    report = json.loads(report)
    found = report["contract"]
    return Contract(
        family=found["family"],
        environment=found["environment"]["id"],
        environment_version=found["environment"]["version"],
        control_period=found["control_period_s"],
        channels=tuple(_channel(row) for row in found["channels"]),
        indices=found["indices"],
        decision=found["decision"]["rule"],
        noise=found["noise"]["rule"],
        noise_elements=found["noise_elements"],
        context=Context(**found["context"]),
        language=found["language"] and Language(**found["language"]),
        instructions=tuple(Instruction(**row) for row in found["instructions"]),
        bundle_sha256=report["bundle_sha256"],
    )


def _channel(row):
    return Channel(
        name=row["name"],
        role=row["role"],
        dtype=DTYPES[row["dtype"]],
        shape=tuple(row["shape"]),
        elements=tuple(Element(**element) for element in row["elements"]),
        min=row["min"],
        max=row["max"],
        quaternion_order=row["quaternion_order"],
        reference=row["reference"],
    )
