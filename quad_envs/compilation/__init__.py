"""How functions become compiled kernels: compiled, kept on disk, handed their arrays, shared by threads."""
