"""One of each thing that people bring: recordings, task suite, simulator, judge, policy, algorithm.

Their choices stand in configs/: worldloop run 'hydra.searchpath=[file://examples/configs]' policy=coarse
"""
