"""CasADi functions to C code, to shared libraries, to numpy arrays. Nothing here knows a robot.

`language`, `vector`, `tape`, `directions` and `places` write C for different uses; `cache` compiles and stores it,
`background` does so in another process, and `mapped` calls the result for all frames of a motion.
"""
