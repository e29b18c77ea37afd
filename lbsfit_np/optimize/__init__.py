"""What every optimisation of a pose shares: model, state and objective, L-BFGS and Gauss–Newton steps, closest surface points."""
