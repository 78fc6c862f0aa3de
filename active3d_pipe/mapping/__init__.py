"""The hybrid map M_k = {F_theta, G_k}: keyframes, window, joint optimisation, refinement."""
