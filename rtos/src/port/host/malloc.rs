//! The C library's allocator, for callers that do not use Rust's: `opendir`, `getline`, C code.
//!
//! Its locks cannot distinguish two tasks. So these functions replace the C library's own in every
//! program that links this crate (glibc supports that). They call the originals, within a critical
//! section if the caller is on the core's thread.

#![allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's promise on"
)]

use super::exclusive::guarded;
use core::ffi::{c_int, c_void};

unsafe extern "C" {
    fn __libc_malloc(bytes: usize) -> *mut c_void;
    fn __libc_calloc(count: usize, bytes: usize) -> *mut c_void;
    fn __libc_realloc(place: *mut c_void, bytes: usize) -> *mut c_void;
    fn __libc_free(place: *mut c_void);
    fn __libc_memalign(align: usize, bytes: usize) -> *mut c_void;
}

#[unsafe(no_mangle)]
unsafe extern "C" fn malloc(bytes: usize) -> *mut c_void {
    guarded(|| __libc_malloc(bytes))
}

#[unsafe(no_mangle)]
unsafe extern "C" fn calloc(count: usize, bytes: usize) -> *mut c_void {
    guarded(|| __libc_calloc(count, bytes))
}

#[unsafe(no_mangle)]
unsafe extern "C" fn realloc(place: *mut c_void, bytes: usize) -> *mut c_void {
    guarded(|| __libc_realloc(place, bytes))
}

#[unsafe(no_mangle)]
unsafe extern "C" fn free(place: *mut c_void) {
    guarded(|| __libc_free(place));
}

#[unsafe(no_mangle)]
unsafe extern "C" fn memalign(align: usize, bytes: usize) -> *mut c_void {
    guarded(|| __libc_memalign(align, bytes))
}

#[unsafe(no_mangle)]
unsafe extern "C" fn aligned_alloc(align: usize, bytes: usize) -> *mut c_void {
    if !align.is_power_of_two() {
        // SAFETY: the address of this thread's errno.
        unsafe { *libc::__errno_location() = libc::EINVAL };
        return core::ptr::null_mut();
    }
    guarded(|| __libc_memalign(align, bytes))
}

#[unsafe(no_mangle)]
unsafe extern "C" fn posix_memalign(to: *mut *mut c_void, align: usize, bytes: usize) -> c_int {
    if !align.is_power_of_two() || !align.is_multiple_of(size_of::<usize>()) {
        return libc::EINVAL;
    }
    // SAFETY: the alignment is valid.
    let place = guarded(|| unsafe { __libc_memalign(align, bytes) });
    if place.is_null() {
        return libc::ENOMEM;
    }
    // SAFETY: the caller passes a valid pointer.
    unsafe { *to = place };
    0
}

/// Refers to these functions, so that the linker includes this file.
pub(super) fn keep() {
    core::hint::black_box(malloc as *const ());
}
