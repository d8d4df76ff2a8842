"""One of each thing that people bring: recordings, a task suite, a simulator, a judge, a policy, an algorithm.

Their choices stand in configs/: worldloop run 'hydra.searchpath=[file://examples/configs]' policy=coarse
"""
