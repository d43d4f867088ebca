"""CasADi functions to C code, to shared libraries, to numpy arrays. Nothing here knows a robot.

`language`, `vector`, `tape`, `forward_mode` and `sample_points` write C for different uses; `cache` compiles and
stores it, `background` does so in another process, and `batch_evaluator` calls the result for all frames of a
motion.
"""
