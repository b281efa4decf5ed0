"""Indexes that store and search descriptors: in memory, with FAISS, or in Milvus."""
