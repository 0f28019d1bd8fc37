"""How certain a contact is: posterior, its covariance, and what else is possible."""
