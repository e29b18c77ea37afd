"""Studies on real rigs: the benchmarks behind the documented figures. They hold no method."""
