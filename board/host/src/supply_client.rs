//! The supply as core 0 sees it: registers in the backplane.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

use tandem_board::{Identity, ResetCause, ResetRequest, RoleLamp, Supply};
use tandem_peripherals::codec::{SERVICE_WORDS, encode_service};
use tandem_peripherals::watchdog::{Window, question};
use tandem_shm::{FitError, bare, fifo};

use crate::backplane::{Backplane, RINGS};
use crate::clock;
use crate::process_list::role_name;
use crate::supply::poke;

/// The registers of a system's supply. Only core 0 services the watchdog.
#[derive(Debug)]
pub struct HostSupply {
    backplane: Backplane,
    of: Identity,
    services: Mutex<fifo::Producer<'static, [u32; SERVICE_WORDS]>>,
    /// Number of watchdog services in this incarnation.
    count: AtomicU32,
    /// The file that sets the name of this process in `ps`, if Linux provides it.
    comm: Option<File>,
}

impl HostSupply {
    pub(crate) fn attach(backplane: Backplane, of: Identity) -> Result<Self, FitError> {
        let ring = RINGS.service[of.system.index()];
        Ok(Self {
            backplane,
            of,
            services: Mutex::new(bare::fifo_producer(backplane.ring(ring), ring.shape)?),
            count: AtomicU32::new(0),
            comm: OpenOptions::new().write(true).open("/proc/self/comm").ok(),
        })
    }
}

impl Supply for HostSupply {
    const WINDOW_OPENS_US: u32 = Window::DESKTOP.opens_us;
    const WINDOW_CLOSES_US: u32 = Window::DESKTOP.closes_us;
    const FIRST_SERVICE_US: u32 = Window::DESKTOP.first_us;

    fn reset_cause(&self) -> ResetCause {
        self.backplane.reset_cause(self.of.system)
    }

    fn starts(&self) -> u8 {
        self.backplane.starts(self.of.system)
    }

    fn confirm_start(&self) {
        self.backplane.confirm_start(self.of.system);
    }

    fn watchdog_question(&self) -> u8 {
        question(self.count.load(Relaxed))
    }

    fn service_watchdog(&self, answer: u8) {
        let service = encode_service(clock::now(), answer);
        let mut services = self.services.lock().unwrap_or_else(PoisonError::into_inner);
        // A full ring means that the supply lags behind. Then the next service is sufficient.
        if services.send(&service).is_ok() {
            self.count.fetch_add(1, Relaxed);
        }
    }

    fn request_reset(&self, request: ResetRequest) {
        self.backplane.request_reset(self.of.system, request);
        poke(self.backplane, self.of.system);
    }

    fn show_role(&self, lamp: RoleLamp) {
        self.backplane.show_role(self.of.system, lamp);
        // One system call and no allocation. The name is only for readers of `ps`, so ignore a
        // failure.
        if let Some(mut comm) = self.comm.as_ref() {
            let (name, length) = process_name(self.of, lamp);
            let _ = comm.write(&name[..length]);
        }
    }
}

/// Number of bytes of a process's name that Linux stores.
const NAME_BYTES: usize = 15;

/// Returns the name of a core in `ps`, for example `A0 master`, and its length.
fn process_name(of: Identity, lamp: RoleLamp) -> ([u8; NAME_BYTES], usize) {
    let role = role_name(lamp);
    let mut name = [0; NAME_BYTES];
    let mut rest = &mut name[..];
    // The end of a long name is cut off.
    let _ = write!(rest, "{}{} {role}", of.system, of.core);
    let length = NAME_BYTES - rest.len();
    (name, length)
}
