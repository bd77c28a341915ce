"""Items dealt to workers: in this process, in others, or on a cluster; and the file that keeps what came of them."""
