"""Corrective labels: what a style's action is beside its own path, found from the demonstrations alone.

`relative_actions` (are actions targets of the state?) → `inverse_model` (which action undoes a deviation?) →
`paths` (where on a demonstration is a state?) → `feedback` (the action there) → `labels` (what a policy is
taught). `docs/contracting.md` derives it.
"""
