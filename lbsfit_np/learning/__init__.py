"""The estimator: Algorithm 1 over a collection of scans, what it keeps in files and between stops, and new scans with that."""
