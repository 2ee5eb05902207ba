//! The state of the redundancy in data flash.

use crate::cell::{self, opaque};
use crate::status::{TandemStatus, TandemStatus as S, status};
use core::ffi::c_void;
use tandem_board::{FlashError, FlashStatus, SystemId};
use tandem_redundancy::{FailureMode, FlashOp, Geometry, Loaded, StateStore, SystemState, Term};

/// System A.
pub const TANDEM_SYSTEM_A: u32 = 0;
/// System B.
pub const TANDEM_SYSTEM_B: u32 = 1;

/// Bytes of a record in the flash.
pub const TANDEM_RECORD_BYTES: usize = 32;

const _: () = assert!(TANDEM_RECORD_BYTES == SystemState::BYTES);

/// The state of a system and its view of the other system, which are kept over resets.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TandemState {
    /// Not 0: this system was the last master, or was initialised as master.
    pub is_master: u32,
    /// Not 0: this system has failed and stays suspended.
    pub sys_failure: u32,
    /// The fault of this system, a `TANDEM_FAILURE_…`.
    pub failure_mode: u32,
    /// Not 0: the other system counts as failed.
    pub cpsys_failure: u32,
    /// Total number of abnormal resets.
    pub abn_resets: u32,
    /// Total number of starts.
    pub total_resets: u32,
    /// Abnormal resets since this system last ran long enough without a fault, 0 ..= 255.
    pub abn_in_a_row: u32,
    /// Incarnations that found their own command wrong since this system last ran long enough
    /// without a fault, 0 ..= 255.
    pub wrong_in_a_row: u32,
    /// The highest mastership term seen or used.
    pub term: u32,
}

/// No fault.
pub const TANDEM_FAILURE_NONE: u32 = 0;
/// Too many abnormal resets in a row.
pub const TANDEM_FAILURE_ABNORMAL_RESETS: u32 = 1;
/// Nothing is received on a CAN bus that is alive.
pub const TANDEM_FAILURE_CAN_OPEN_CIRCUIT: u32 = 2;
/// The output driver's diagnosis register reports a fault.
pub const TANDEM_FAILURE_IO_MODULE: u32 = 3;
/// Core 1 does not answer.
pub const TANDEM_FAILURE_PERCEPTION_CORE: u32 = 4;
/// Core 2 does not answer.
pub const TANDEM_FAILURE_PLANNING_CORE: u32 = 5;
/// Control cycles are late repeatedly.
pub const TANDEM_FAILURE_DEADLINE: u32 = 6;
/// No mastership term is left.
pub const TANDEM_FAILURE_TERMS_EXHAUSTED: u32 = 7;
/// The system's command does not follow from its inputs, or does not reach the vehicle unchanged.
pub const TANDEM_FAILURE_WRONG_COMMAND: u32 = 8;
/// The system's clock differs too much from the vehicle's and the other system's.
pub const TANDEM_FAILURE_CLOCK: u32 = 9;
/// The system's CAN controller was bus-off.
pub const TANDEM_FAILURE_CAN_BUS_OFF: u32 = 10;
/// The system's scene or plan contradicts the sensors' frames.
pub const TANDEM_FAILURE_WRONG_SCENE: u32 = 11;

const _: () = {
    use FailureMode as F;
    assert!(F::AbnormalResets as u32 == TANDEM_FAILURE_ABNORMAL_RESETS);
    assert!(F::CanOpenCircuit as u32 == TANDEM_FAILURE_CAN_OPEN_CIRCUIT);
    assert!(F::IoModule as u32 == TANDEM_FAILURE_IO_MODULE);
    assert!(F::PerceptionCore as u32 == TANDEM_FAILURE_PERCEPTION_CORE);
    assert!(F::PlanningCore as u32 == TANDEM_FAILURE_PLANNING_CORE);
    assert!(F::Deadline as u32 == TANDEM_FAILURE_DEADLINE);
    assert!(F::TermsExhausted as u32 == TANDEM_FAILURE_TERMS_EXHAUSTED);
    assert!(F::WrongCommand as u32 == TANDEM_FAILURE_WRONG_COMMAND);
    assert!(F::Clock as u32 == TANDEM_FAILURE_CLOCK);
    assert!(F::CanBusOff as u32 == TANDEM_FAILURE_CAN_BUS_OFF);
    assert!(F::WrongScene as u32 == TANDEM_FAILURE_WRONG_SCENE);
};

/// The flash holds a state.
pub const TANDEM_LOADED_STATE: u32 = 0;
/// The flash was never written.
pub const TANDEM_LOADED_BLANK: u32 = 1;
/// The flash was written, but holds no valid record.
pub const TANDEM_LOADED_LOST: u32 = 2;

/// The record that was found in the flash.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemLoaded {
    /// A `TANDEM_LOADED_…`.
    pub kind: u32,
    /// The state, if `kind` is `TANDEM_LOADED_STATE`.
    pub state: TandemState,
}

/// There is no operation to start.
pub const TANDEM_FLASH_NOTHING: u32 = 0;
/// Erase sector `sector`.
pub const TANDEM_FLASH_ERASE: u32 = 1;
/// Program `data` at `offset`.
pub const TANDEM_FLASH_PROGRAM: u32 = 2;

/// The next operation on the flash.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemFlashOp {
    /// `TANDEM_FLASH_NOTHING`, `TANDEM_FLASH_ERASE` or `TANDEM_FLASH_PROGRAM`.
    pub kind: u32,
    /// The number of the sector in the flash.
    pub sector: u32,
    /// Offset from the start of the flash, in bytes.
    pub offset: u32,
    /// The data of one record.
    pub data: [u8; TANDEM_RECORD_BYTES],
}

/// The flash is ready; its last operation is durable.
pub const TANDEM_FLASH_IDLE: u32 = 0;
/// An operation is under way.
pub const TANDEM_FLASH_BUSY: u32 = 1;
/// The last operation failed.
pub const TANDEM_FLASH_FAILED: u32 = 2;

/// The store, which writes states to two sectors of the flash, one operation at a time, without
/// waiting. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemStore {
    /// Private.
    pub opaque: [u64; 16],
}

opaque!(TandemStore, StateStore, 0x0D);

/// A function that copies `count` bytes at `offset` of the flash to `into`; returns 0 on success.
pub type TandemFlashRead = Option<
    unsafe extern "C" fn(context: *mut c_void, offset: u32, into: *mut u8, count: u32) -> i32,
>;

impl TandemState {
    const fn new(state: SystemState) -> Self {
        Self {
            is_master: state.is_master as u32,
            sys_failure: state.sys_failure as u32,
            failure_mode: state.failure_mode as u32,
            cpsys_failure: state.cpsys_failure as u32,
            abn_resets: state.abn_resets,
            total_resets: state.total_resets,
            abn_in_a_row: state.abn_in_a_row as u32,
            wrong_in_a_row: state.wrong_in_a_row as u32,
            term: state.term.bits(),
        }
    }

    pub(crate) const fn factory(system: SystemId) -> Self {
        Self::new(SystemState::factory(system))
    }
}

impl From<SystemState> for TandemState {
    fn from(state: SystemState) -> Self {
        Self::new(state)
    }
}

pub(crate) fn system_id(number: u32) -> Result<SystemId, S> {
    match number {
        TANDEM_SYSTEM_A => Ok(SystemId::A),
        TANDEM_SYSTEM_B => Ok(SystemId::B),
        _ => Err(S::OutOfRange),
    }
}

pub(crate) fn failure_mode(number: u32) -> Result<FailureMode, S> {
    let number = u8::try_from(number).map_err(|_| S::OutOfRange)?;
    Ok(FailureMode::from_code(number))
}

impl TandemState {
    pub(crate) fn checked(&self) -> Result<SystemState, S> {
        Ok(SystemState {
            is_master: self.is_master != 0,
            sys_failure: self.sys_failure != 0,
            failure_mode: failure_mode(self.failure_mode)?,
            cpsys_failure: self.cpsys_failure != 0,
            abn_resets: self.abn_resets,
            total_resets: self.total_resets,
            abn_in_a_row: u8::try_from(self.abn_in_a_row).map_err(|_| S::OutOfRange)?,
            wrong_in_a_row: u8::try_from(self.wrong_in_a_row).map_err(|_| S::OutOfRange)?,
            term: Term::from_bits(self.term),
        })
    }
}

impl TandemLoaded {
    pub(crate) fn checked(&self) -> Result<Loaded, S> {
        match self.kind {
            TANDEM_LOADED_STATE => Ok(Loaded::State(self.state.checked()?)),
            TANDEM_LOADED_BLANK => Ok(Loaded::Blank),
            TANDEM_LOADED_LOST => Ok(Loaded::Lost),
            _ => Err(S::OutOfRange),
        }
    }
}

/// Writes the initial state of a new system: master for A (0), standby for B (1).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_state_factory(
    state: *mut TandemState,
    system: u32,
) -> TandemStatus {
    status(|| cell::write(state, TandemState::factory(system_id(system)?)))
}

/// Reads the record from two sectors, `first_sector` and the next one, of `sector_bytes` bytes each
/// (a multiple of `TANDEM_RECORD_BYTES`). Call it when the system starts; it reads both sectors.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply; `read` may be called with `context`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_store_load(
    store: *mut TandemStore,
    sector_bytes: u32,
    first_sector: u32,
    read: TandemFlashRead,
    context: *mut c_void,
    loaded: *mut TandemLoaded,
) -> TandemStatus {
    status(|| {
        cell::writable(loaded)?;
        let read = read.ok_or(S::BadPointer)?;
        let in_range = |end: u64| {
            end.checked_mul(sector_bytes.into())
                .is_some_and(|end| end <= u64::from(u32::MAX))
        };
        let records = sector_bytes != 0 && sector_bytes.is_multiple_of(TANDEM_RECORD_BYTES as u32);
        if !records || !in_range(u64::from(first_sector) + 2) {
            return Err(S::OutOfRange);
        }
        let geometry = Geometry {
            sector_bytes,
            first_sector,
        };
        let (found, what) = StateStore::load(geometry, |offset, into| {
            let (first, count) = (into.as_mut_ptr(), into.len() as u32);
            // SAFETY: a function of C with this signature, its own context, and `count` bytes.
            match unsafe { read(context, offset, first, count) } {
                0 => Ok(()),
                _ => Err(FlashError::Failed),
            }
        });
        let blank = SystemState::factory(SystemId::A);
        let (kind, state) = match what {
            Loaded::State(state) => (TANDEM_LOADED_STATE, state),
            Loaded::Blank => (TANDEM_LOADED_BLANK, blank),
            Loaded::Lost => (TANDEM_LOADED_LOST, blank),
        };
        let state = state.into();
        cell::write(loaded, TandemLoaded { kind, state })?;
        cell::put(store, found)
    })
}

/// Requests that the store write the state from the actions of the redundancy. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_store_request(
    store: *mut TandemStore,
    state: *const TandemState,
) -> TandemStatus {
    status(|| {
        let (store, state) = (cell::get(store)?, cell::read(state)?);
        state.checked().map(|state| store.request(state))
    })
}

/// Writes to `op` the operation to start now. `flash` is a `TANDEM_FLASH_IDLE`, `_BUSY` or
/// `_FAILED`. Start it before the next call, or call `tandem_store_refused`. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_store_poll(
    store: *mut TandemStore,
    flash: u32,
    op: *mut TandemFlashOp,
) -> TandemStatus {
    status(|| {
        cell::writable(op)?;
        let flash = match flash {
            TANDEM_FLASH_IDLE => FlashStatus::Idle,
            TANDEM_FLASH_BUSY => FlashStatus::Busy,
            TANDEM_FLASH_FAILED => FlashStatus::Failed,
            _ => return Err(S::OutOfRange),
        };
        let mut next = TandemFlashOp {
            kind: TANDEM_FLASH_NOTHING,
            sector: 0,
            offset: 0,
            data: [0; TANDEM_RECORD_BYTES],
        };
        match cell::get(store)?.poll(flash) {
            None => {}
            Some(FlashOp::Erase { sector }) => {
                next.kind = TANDEM_FLASH_ERASE;
                next.sector = sector;
            }
            Some(FlashOp::Program { offset, data }) => {
                next.kind = TANDEM_FLASH_PROGRAM;
                next.offset = offset;
                next.data = data;
            }
        }
        // SAFETY: rule 1 of the caller's contract.
        unsafe { cell::write(op, next) }
    })
}

/// Reports that the last operation was not started; the next poll returns it again. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_store_refused(store: *mut TandemStore) -> TandemStatus {
    status(|| cell::get(store).map(StateStore::refused))
}

/// Returns 1 if every requested state is durable or was given up, otherwise 0. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_store_is_settled(store: *mut TandemStore) -> u32 {
    cell::get(store).map_or(0, |store| store.is_settled().into())
}
