"""What stands where: cameras, instruments, detectors and jobs in YAML, and what turns them into optical assemblies and
scenes.
"""
