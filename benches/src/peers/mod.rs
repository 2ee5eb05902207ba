//! What one would use instead, each as its documentation recommends.

mod ddsperf;
mod iceoryx2_event;
mod iceoryx2_pubsub;
mod iceoryx2_semaphore;
mod iceoryx2_size;
mod malloc;
mod mutex;
mod pipe;
mod threads;

pub use ddsperf::ddsperf;
pub use iceoryx2_event::{iceoryx2_at_rate, iceoryx2_chain, iceoryx2_event, iceoryx2_event_tuned};
pub use iceoryx2_pubsub::{iceoryx2_pubsub, iceoryx2_pubsub_tuned, iceoryx2_stream};
pub use iceoryx2_size::iceoryx2_size;
pub use malloc::malloc_free;
pub use mutex::{Death, contended_mutex, mutex, mutex_recovery};
pub use pipe::{message_queue, pipe, pipe_stream, unix_socket};
pub use threads::{crossbeam_channel, crossbeam_stream, rtrb, rtrb_stream};
