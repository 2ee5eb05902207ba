//! What one would use instead, each as its documentation recommends.

mod iceoryx2_event;
mod iceoryx2_pubsub;
mod pipe;
mod threads;

pub use iceoryx2_event::iceoryx2_event;
pub use iceoryx2_pubsub::iceoryx2_pubsub;
pub use pipe::{message_queue, pipe, unix_socket};
pub use threads::{crossbeam_channel, rtrb};
