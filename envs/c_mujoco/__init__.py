"""Tasks that C MuJoCo steps: many episodes at once, or one."""
