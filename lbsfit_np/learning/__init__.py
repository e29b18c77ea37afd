"""The estimator: what is learnt once for a rig, and many scans fitted with it."""
