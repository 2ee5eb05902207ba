//! A value that lives in a static or, counted, on the heap.

#[cfg(feature = "alloc")]
use alloc::sync::Arc;
use core::ops::Deref;

/// The address of the value never changes, whichever it is: the kernel keeps pointers into it.
pub(crate) enum Shared<T: 'static> {
    Static(&'static T),
    #[cfg(feature = "alloc")]
    Heap(Arc<T>),
}

impl<T> Clone for Shared<T> {
    fn clone(&self) -> Self {
        match self {
            Self::Static(value) => Self::Static(value),
            #[cfg(feature = "alloc")]
            Self::Heap(value) => Self::Heap(Arc::clone(value)),
        }
    }
}

impl<T> Deref for Shared<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match self {
            Self::Static(value) => value,
            #[cfg(feature = "alloc")]
            Self::Heap(value) => value,
        }
    }
}
