"""Forecasts before anything is built: what rigs will see of hands at work, and where cameras should be."""
