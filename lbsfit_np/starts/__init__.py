"""Where a fit begins: what of a scan takes part, its unit and turn, and poses from a library, from f and from labelled parts."""
