"""Playing policies of runs to look at them: in MJX, C MuJoCo, Gymnasium, or a viewer."""
