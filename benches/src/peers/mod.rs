//! What one would use instead, each as its documentation recommends.

mod iceoryx2;
mod iceoryx2_semaphore;
mod kernel;
mod mutex;
mod polling;

pub(crate) use iceoryx2::{
    blackboard as iceoryx2_blackboard, event as iceoryx2_event, event_at_rate as iceoryx2_at_rate,
    event_tuned as iceoryx2_event_tuned, pubsub as iceoryx2_pubsub,
    pubsub_tuned as iceoryx2_pubsub_tuned, request as iceoryx2_request, size as iceoryx2_size,
    stream as iceoryx2_stream,
};
pub(crate) use kernel::{eventfd, io_uring, pipe, pipe_stream, unix_socket};
pub(crate) use mutex::{Death, contended_mutex, mutex, mutex_recovery};
pub(crate) use polling::{rtrb, rtrb_stream, seqlock, triple_buffer};
