"""The true world: a MuJoCo bench with two arms. Only env.py imports torch, so worker processes start fast."""
