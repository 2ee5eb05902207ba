//! What one would use instead, each as its documentation recommends.

mod iceoryx2_blackboard;
mod iceoryx2_event;
mod iceoryx2_pubsub;
mod iceoryx2_request;
mod iceoryx2_semaphore;
mod io_uring;
mod mutex;
mod pipe;
mod seqlock;
mod threads;

pub use iceoryx2_blackboard::iceoryx2_blackboard;
pub use iceoryx2_event::{iceoryx2_at_rate, iceoryx2_event, iceoryx2_event_tuned};
pub use iceoryx2_pubsub::{iceoryx2_pubsub, iceoryx2_pubsub_tuned, iceoryx2_size, iceoryx2_stream};
pub use iceoryx2_request::iceoryx2_request;
pub use io_uring::io_uring;
pub use mutex::{Death, contended_mutex, mutex, mutex_recovery};
pub use pipe::{pipe, pipe_stream, unix_socket};
pub use seqlock::seqlock;
pub use threads::{rtrb, rtrb_stream, triple_buffer};
