"""Any simulator behind GE-Sim's protocol: sessions, their shared forward passes, HTTP, and a page to watch
them.
"""
