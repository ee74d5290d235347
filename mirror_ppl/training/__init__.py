"""Network training: the self-model on rounds of the robot, guides on simulated people."""
