"""How sure an identification is: covariance, motions that do not tell, and the motion to make next."""
