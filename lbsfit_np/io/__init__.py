"""Files: one format a module. Units and frames are converted here and nowhere else; holds no method."""
