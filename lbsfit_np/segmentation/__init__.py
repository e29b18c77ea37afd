"""The segmenter s: which part of the rig each point of a scan belongs to."""
