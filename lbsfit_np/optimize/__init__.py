"""What every optimisation of a pose shares: the normalised model, the state and its layout, the objective, L-BFGS."""
