"""The paper's study in its classical form: data by its recipe, every row of its tables, its figures, one results file."""
