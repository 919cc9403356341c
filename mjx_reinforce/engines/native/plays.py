"""What machine code is told of each episode: whether it is played, and by what actions."""

#: The episode is not played; its actions are samples; its actions are the distribution's mode.
NOT_PLAYED, SAMPLES, MODE = range(3)
