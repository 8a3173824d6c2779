"""Train, evaluate, film and plot teams from the command line, in the manner of RL-Zoo."""
