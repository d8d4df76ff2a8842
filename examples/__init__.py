"""One of each thing that people bring: a task suite, a simulator, a judge, a policy, an algorithm, a robot's
data.
"""
