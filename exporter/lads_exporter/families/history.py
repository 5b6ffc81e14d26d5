"""Family `history`: as `lads`, with a low level that remembers a window of steps; the high level may read observations alone."""

from .family import ARGMAX, CODEBOOK, LOW_LEVEL, Family, first_or_later, recall


def step(twin):
    if twin.family.get("actions"):
        first_or_later(twin)
    else:
        twin.run("high_level/step")
    if twin.decides:
        twin.select()
    recall(twin)


FAMILY = Family(
    step,
    ("horizon", *CODEBOOK, "window", "memory.dim", *LOW_LEVEL),
    {"decision": ARGMAX},
    rings=lambda family: {"row": family["window"]},
)
