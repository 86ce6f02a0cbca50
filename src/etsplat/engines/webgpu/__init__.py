"""The engine "webgpu": drawing on any GPU by WGSL, through the package wgpu."""
