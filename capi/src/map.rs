//! The LMU: layout, map, incarnations.

use crate::cell::{self, Opaque, TandemWords, opaque};
use crate::status::{TandemStatus, TandemStatus as S, status};
use core::ffi::{CStr, c_char, c_void};
use core::sync::atomic::AtomicU32;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::map::{Layout, Map, MapError};

/// Cores that share an LMU; they are numbered from 0.
pub const TANDEM_CORES: usize = 3;
/// The largest number of regions of a layout.
pub const TANDEM_MAX_REGIONS: usize = 32;
/// The maximum length of a region's name, in bytes.
pub const TANDEM_MAX_NAME: usize = 31;

const _: () = assert!(TANDEM_CORES == tandem_shm::incarnation::CORES);

/// One region of a layout. Every image of a system, in C or in Rust, must have the same names and
/// sizes in the same order.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemRegion {
    /// The name: UTF-8, at most `TANDEM_MAX_NAME` bytes.
    pub name: *const c_char,
    /// Number of words of 4 bytes: `TANDEM_LOCK_WORDS`, `TANDEM_FIFO_WORDS(…)`, …
    pub words: usize,
}

/// A layout of an LMU. Must be static and initially zero; `tandem_layout_init` initialises it.
#[repr(C)]
#[derive(Debug)]
pub struct TandemLayout {
    /// Private.
    pub opaque: [usize; 98],
}

/// An LMU that this core is attached to. Must be static and initially zero; `tandem_map_format` or
/// `tandem_map_attach` initialises it.
#[repr(C)]
#[derive(Debug)]
pub struct TandemMap {
    /// Private.
    pub opaque: [usize; 8],
}

/// A layout, and the place of each region.
pub(crate) struct Regions {
    layout: Layout,
    /// First word and number of words of each region.
    places: [(u32, u32); TANDEM_MAX_REGIONS],
    count: usize,
}

pub(crate) struct Attached {
    map: Map<'static>,
    regions: &'static Regions,
}

opaque!(TandemLayout, Regions, 0x01);
opaque!(TandemMap, Attached, 0x02);

/// Makes a layout of `count` regions (1 ..= `TANDEM_MAX_REGIONS`) and writes it to `into`, which
/// must not move as long as a map uses it. Tasks only; does not block.
///
/// `TANDEM_STATUS_OUT_OF_RANGE` if there are too many regions, a name is too long or not UTF-8, or
/// a size is 0 or above 2^24 words.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_layout_init(
    into: *mut TandemLayout,
    regions: *const TandemRegion,
    count: usize,
) -> TandemStatus {
    status(|| {
        if count == 0 || count > TANDEM_MAX_REGIONS {
            return Err(S::OutOfRange);
        }
        let mut layout = Layout::EMPTY;
        let mut places = [(0, 0); TANDEM_MAX_REGIONS];
        for (index, place) in places[..count].iter_mut().enumerate() {
            // SAFETY: rule 1 of the caller's contract, for `count` regions.
            let given = unsafe { cell::read(regions.wrapping_add(index)) }?;
            if given.words == 0 || given.words > 1 << 24 {
                return Err(S::OutOfRange);
            }
            *place = (layout.total_words() as u32, given.words as u32);
            // SAFETY: rule 1 of the caller's contract.
            layout = layout.with(unsafe { name(given.name) }?, given.words);
        }
        let regions = Regions {
            layout,
            places,
            count,
        };
        // SAFETY: rules 1 and 3 of the caller's contract.
        unsafe { cell::put(into, regions) }
    })
}

/// Returns a string of C, of at most [`TANDEM_MAX_NAME`] bytes.
///
/// # Safety
/// `first` is null, or points to a string that ends with 0, or to [`TANDEM_MAX_NAME`] + 1 bytes.
unsafe fn name<'c>(first: *const c_char) -> Result<&'c str, S> {
    if first.is_null() {
        return Err(S::BadPointer);
    }
    // SAFETY: reads no further than the end of the string.
    let len = (0..=TANDEM_MAX_NAME).find(|&at| unsafe { first.add(at).read() } == 0);
    if len.is_none() {
        return Err(S::OutOfRange);
    }
    // SAFETY: the end was found.
    let name = unsafe { CStr::from_ptr(first) };
    name.to_str().map_err(|_| S::OutOfRange)
}

/// Formats an LMU of `bytes` bytes at `base` (a multiple of 64): zeroes it and writes the layout.
/// The boot core or the supply calls this at power-on, before any other core uses the LMU. If only
/// the boot core is reset, it attaches instead. Tasks only; takes the time to write the whole LMU.
///
/// `TANDEM_STATUS_TOO_SMALL`, `TANDEM_STATUS_MISALIGNED`
///
/// # Safety
/// Rules 1, 2 and 3 of the caller's contract apply; `layout` does not move.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_map_format(
    map: *mut TandemMap,
    layout: *const TandemLayout,
    base: *mut c_void,
    bytes: usize,
) -> TandemStatus {
    status(|| {
        let (regions, words) = parts(layout, base, bytes)?;
        let (object, map) = (map, Map::format(words, regions.layout)?);
        // SAFETY: rules 1 and 3 of the caller's contract.
        unsafe { cell::put(object, Attached { map, regions }) }
    })
}

/// Attaches to an LMU that was formatted with the same layout. Tasks only; does not block.
///
/// `TANDEM_STATUS_NOT_READY` (try again), `TANDEM_STATUS_WRONG_MAGIC`, `_WRONG_VERSION`,
/// `_WRONG_LAYOUT`, `_TOO_SMALL`, `_MISALIGNED`
///
/// # Safety
/// Rules 1, 2 and 3 of the caller's contract apply; `layout` does not move.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_map_attach(
    map: *mut TandemMap,
    layout: *const TandemLayout,
    base: *mut c_void,
    bytes: usize,
) -> TandemStatus {
    status(|| {
        let (regions, words) = parts(layout, base, bytes)?;
        let (object, map) = (map, Map::attach(words, regions.layout)?);
        // SAFETY: rules 1 and 3 of the caller's contract.
        unsafe { cell::put(object, Attached { map, regions }) }
    })
}

impl From<MapError> for S {
    fn from(error: MapError) -> Self {
        match error {
            MapError::TooSmall => Self::TooSmall,
            MapError::Misaligned => Self::Misaligned,
            MapError::NotReady => Self::NotReady,
            MapError::WrongMagic => Self::WrongMagic,
            MapError::WrongVersion => Self::WrongVersion,
            MapError::WrongLayout => Self::WrongLayout,
        }
    }
}

/// # Safety
/// Rules 1 and 2 of the caller's contract apply; `layout` does not move.
unsafe fn parts(
    layout: *const TandemLayout,
    base: *mut c_void,
    bytes: usize,
) -> Result<(&'static Regions, &'static [AtomicU32]), S> {
    // SAFETY: rule 1; a layout is written once and then only read.
    let regions: &'static Regions = unsafe { cell::share(layout) }?;
    let first = base.cast::<AtomicU32>();
    if first.is_null() {
        return Err(S::BadPointer);
    }
    if !first.addr().is_multiple_of(64) {
        return Err(S::Misaligned);
    }
    if bytes > isize::MAX as usize {
        return Err(S::OutOfRange);
    }
    // SAFETY: aligned. By rule 2 the LMU has this many bytes and stays mapped. Words are atomics,
    // so other cores may write to them.
    let words = unsafe { core::slice::from_raw_parts(first, bytes / 4) };
    Ok((regions, words))
}

/// Returns the words of a region.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn region(
    map: *const TandemMap,
    index: usize,
) -> Result<&'static [AtomicU32], S> {
    // SAFETY: the caller guarantees rule 1; a map is written once and then only read.
    let attached = unsafe { cell::share(map) }?;
    let places = &attached.regions.places[..attached.regions.count];
    let &(begin, count) = places.get(index).ok_or(S::OutOfRange)?;
    Ok(attached.map.words(begin as usize, count as usize)?)
}

/// Makes an end in region `index`, and writes it to memory of C.
///
/// # Safety
/// Rules 1, 2 and 3 of the caller's contract apply.
pub(crate) unsafe fn attach<O: Opaque>(
    object: *mut O,
    map: *const TandemMap,
    index: usize,
    end: impl FnOnce(&'static [AtomicU32], Incarnations<'static>) -> Result<O::Inner, S>,
) -> TandemStatus {
    status(|| cell::put(object, end(region(map, index)?, incarnations(map)?)?))
}

/// Returns the incarnation table.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn incarnations(map: *const TandemMap) -> Result<Incarnations<'static>, S> {
    // SAFETY: the caller guarantees rule 1; a map is written once and then only read.
    Ok(unsafe { cell::share(map) }?.map.incarnations())
}

pub(crate) fn incarnation(core: u32, generation: u32) -> Result<Incarnation, S> {
    Incarnation::new(core as usize, generation).ok_or(S::OutOfRange)
}

/// Writes the words of region `index` of the layout, rounded up to whole cache lines, to `words`.
/// Use it for the firmware's own data. Any context; does not block.
///
/// `TANDEM_STATUS_OUT_OF_RANGE` if there is no such region.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_map_region(
    map: *const TandemMap,
    index: usize,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| cell::write(words, TandemWords::of(region(map, index)?)))
}

/// Announces incarnation number `generation` (1 ..= 2^30 - 1) of core `core`, when it starts. From
/// then on other cores may take over objects that an earlier incarnation of this core owned. Tasks
/// only; does not block.
///
/// `TANDEM_STATUS_OUTDATED` if this incarnation is not the latest, or was marked dead: it must
/// stop.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_incarnation_announce(
    map: *const TandemMap,
    core: u32,
    generation: u32,
) -> TandemStatus {
    status(|| {
        let announced = incarnations(map)?.announce(incarnation(core, generation)?);
        announced.map_err(|_| S::Outdated)
    })
}

/// Marks an incarnation as dead. The supervisor of the cores calls this after the incarnation has
/// ended. Any context; does not block.
///
/// `TANDEM_STATUS_OUTDATED` if it is not the announced incarnation, or is already marked.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_incarnation_mark_dead(
    map: *const TandemMap,
    core: u32,
    generation: u32,
) -> TandemStatus {
    status(
        || match incarnations(map)?.mark_dead(incarnation(core, generation)?) {
            true => Ok(()),
            false => Err(S::Outdated),
        },
    )
}

/// Returns the generation of the living incarnation of a core; 0 if there is none, or an argument
/// is not valid. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_incarnation_current(map: *const TandemMap, core: u32) -> u32 {
    let incarnations = incarnations(map);
    match (incarnations, core as usize) {
        (Ok(incarnations), core) if core < TANDEM_CORES => incarnations
            .current(core)
            .map_or(0, |incarnation| incarnation.generation()),
        _ => 0,
    }
}
