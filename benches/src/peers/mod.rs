//! The alternatives to Tandem, each used as its documentation recommends.

pub(crate) mod ddsperf;
pub(crate) mod iceoryx2;
mod iceoryx2_semaphore;
pub(crate) mod kernel;
pub(crate) mod mutex;
pub(crate) mod polling;
