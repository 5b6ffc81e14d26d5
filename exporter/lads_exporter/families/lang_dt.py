"""Family `lang_dt`: the high level's output is the action, at every step; no plan and no low level."""

from .family import Family, first_or_later

FAMILY = Family(first_or_later)
