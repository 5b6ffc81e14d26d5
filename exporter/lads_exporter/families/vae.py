"""Family `vae`: a plan is the mean or a draw of a distribution; the low level may remember a window of steps."""

from .family import LOW_LEVEL, MEAN, Family, first_or_later, recall

HISTORY = tuple(f"history.{name}" for name in ("window", "memory.dim", *LOW_LEVEL))


def step(twin):
    first_or_later(twin)
    if twin.decides:
        twin.run("plan/sample")
    if "history" in twin.family:
        recall(twin)
    else:
        twin.run("low_level/act")


def rings(family):
    return {"row": family["history"]["window"]} if "history" in family else {}


FAMILY = Family(step, ("horizon", "plan.dim"), {"decision": MEAN}, optional=HISTORY, rings=rings)
