"""Forecasts before anything is built: what rigs will see of hands at work, and where their cameras should stand."""
