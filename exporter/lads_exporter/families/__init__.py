"""The families of policies, a module each: what their contract says and which entries a control step runs.

A module has the numbers that the contract's `family` must give and `step(twin)`, the schedule as the exporter's twin of the controller runs
it (`twin.Twin`); the runtime's own is `runtime/compiler/src/family/`. Nothing here fails: `contract.check` refuses what a row does not allow.
"""

from . import history, lads, lang_dt, lcsd, lisa, plain, skilldiffuser, vae

FAMILIES = {
    "lads": lads.FAMILY,
    "lang_dt": lang_dt.FAMILY,
    "lisa": lisa.FAMILY,
    "vae": vae.FAMILY,
    "lcsd": lcsd.FAMILY,
    "skilldiffuser": skilldiffuser.FAMILY,
    "history": history.FAMILY,
    "plain": plain.FAMILY,
}
