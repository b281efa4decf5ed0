"""Where earlier descriptors are kept and searched: in memory, by FAISS, or in Milvus."""
