"""What plans come to, exactly where that is cheap, else sampled (`trial.py`); and the best of many (`halving.py`)."""
