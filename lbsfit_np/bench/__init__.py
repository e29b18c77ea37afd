"""The benchmarks behind the documented figures, and correspondences of one's own scans. They hold no method."""
