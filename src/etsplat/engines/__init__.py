"""Who computes: one folder for each engine, one method for each operation (`engine.py`), one place that chooses."""
