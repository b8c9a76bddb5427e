"""How functions become compiled kernels: compiled, kept on disk, handed their arrays, shared by threads.

`intrinsics`, `tiles` and `normals` are what kernels say in vector instructions: registers, matrices, noise.
"""
