"""Populations: agents that train at once and take over from each other (population-based training).

`variation` has what may differ between members, `decisions` who copies whom and with which
settings, `population` the members and their generations.
"""
