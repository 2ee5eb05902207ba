//! The board as processes on a laptop, over iceoryx2.
