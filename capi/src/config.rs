//! The configuration of the redundancy.

use crate::cell;
use crate::status::{TandemStatus, TandemStatus as S, status};
use tandem_board::Duration;
use tandem_redundancy::Config;

/// Periods and limits of the redundancy; both systems must use the same values. Times are in
/// microseconds. Start with `tandem_config_rt`, change the values that differ, and check with
/// `tandem_config_check` that they still fit together. `docs/redundancy.md` explains each value and
/// the reason for it.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemConfig {
    /// Time between two heartbeats on each line.
    pub heartbeat_period_us: u32,
    /// Number of consecutive missing heartbeats after which a line counts as silent.
    pub heartbeat_misses: u32,
    /// Further delay of a heartbeat that is tolerated.
    pub heartbeat_jitter_us: u32,
    /// Longest time between two polls.
    pub poll_interval_us: u32,
    /// Silence of both lines after which the master counts its standby as failed.
    pub standby_limit_us: u32,
    /// Period of the control frames.
    pub control_period_us: u32,
    /// Delay of a control frame that is tolerated.
    pub control_margin_us: u32,
    /// Number of control periods without a control frame or an echo after which a master is mute.
    pub mute_periods: u32,
    /// Time between two handshake edges.
    pub handshake_period_us: u32,
    /// Longest time that a system waits at power-on for the other system's handshake.
    pub start_limit_us: u32,
    /// Additional time that B waits when both systems might act at the same time.
    pub stagger_us: u32,
    /// Additional time that B waits before its sync edge.
    pub sync_stagger_us: u32,
    /// Longest time that a standby that has received a handshake waits for the sync edge.
    pub promote_limit_us: u32,
    /// Time with heartbeats after which the other system counts as recovered.
    pub recover_after_us: u32,
    /// If not 0, dual operation resumes at run time when the other system has recovered.
    pub reintegrate: u32,
    /// Number of consecutive abnormal resets that are tolerated, 1 ..= 255.
    pub abnormal_limit: u32,
    /// Interval without a reset after which the count of consecutive abnormal resets falls by one.
    pub healthy_after_us: u32,
    /// Time without a frame on CAN after which the circuit counts as open, if the other system
    /// reports a live bus.
    pub can_open_limit_us: u32,
    /// Time between two reports over the link.
    pub report_period_us: u32,
    /// Time for which a report from the other system is valid.
    pub report_limit_us: u32,
    /// Time without a status frame of the standby on CAN after which a master has no backup.
    pub status_limit_us: u32,
    /// Time after a change of the driver during which a new standby takes over only if the
    /// vehicle's report demands it.
    pub hold_down_us: u32,
}

impl From<Config> for TandemConfig {
    fn from(config: Config) -> Self {
        let us = |span: Duration| span.as_us() as u32;
        Self {
            heartbeat_period_us: us(config.heartbeat_period),
            heartbeat_misses: config.heartbeat_misses,
            heartbeat_jitter_us: us(config.heartbeat_jitter),
            poll_interval_us: us(config.poll_interval),
            standby_limit_us: us(config.standby_limit),
            control_period_us: us(config.control_period),
            control_margin_us: us(config.control_margin),
            mute_periods: config.mute_periods,
            handshake_period_us: us(config.handshake_period),
            start_limit_us: us(config.start_limit),
            stagger_us: us(config.stagger),
            sync_stagger_us: us(config.sync_stagger),
            promote_limit_us: us(config.promote_limit),
            recover_after_us: us(config.recover_after),
            reintegrate: config.reintegrate.into(),
            abnormal_limit: config.abnormal_limit.into(),
            healthy_after_us: us(config.healthy_after),
            can_open_limit_us: us(config.can_open_limit),
            report_period_us: us(config.report_period),
            report_limit_us: us(config.report_limit),
            status_limit_us: us(config.status_limit),
            hold_down_us: us(config.hold_down),
        }
    }
}

impl TandemConfig {
    /// Returns the configuration if its values fit together.
    pub(crate) fn checked(&self) -> Result<Config, S> {
        let span = |us: u32| Duration::from_us(us.into());
        let config = Config {
            heartbeat_period: span(self.heartbeat_period_us),
            heartbeat_misses: self.heartbeat_misses,
            heartbeat_jitter: span(self.heartbeat_jitter_us),
            poll_interval: span(self.poll_interval_us),
            standby_limit: span(self.standby_limit_us),
            control_period: span(self.control_period_us),
            control_margin: span(self.control_margin_us),
            mute_periods: self.mute_periods,
            handshake_period: span(self.handshake_period_us),
            start_limit: span(self.start_limit_us),
            stagger: span(self.stagger_us),
            sync_stagger: span(self.sync_stagger_us),
            promote_limit: span(self.promote_limit_us),
            recover_after: span(self.recover_after_us),
            reintegrate: self.reintegrate != 0,
            abnormal_limit: u8::try_from(self.abnormal_limit).map_err(|_| S::OutOfRange)?,
            healthy_after: span(self.healthy_after_us),
            can_open_limit: span(self.can_open_limit_us),
            report_period: span(self.report_period_us),
            report_limit: span(self.report_limit_us),
            status_limit: span(self.status_limit_us),
            hold_down: span(self.hold_down_us),
        };
        config.check().then_some(config).ok_or(S::OutOfRange)
    }
}

/// Writes the profile for chips, where no task stalls and reports are as frequent as heartbeats.
///
/// # Safety
/// Rule 1 of the caller's contract applies.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_config_chip(config: *mut TandemConfig) -> TandemStatus {
    status(|| cell::write(config, Config::chip().into()))
}

/// Writes the profile for firmware, for systems whose timers are late by far less than 1 ms.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_config_rt(config: *mut TandemConfig) -> TandemStatus {
    status(|| cell::write(config, Config::rt().into()))
}

/// Checks that the values fit together; otherwise returns `TANDEM_STATUS_OUT_OF_RANGE`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_config_check(config: *const TandemConfig) -> TandemStatus {
    status(|| cell::read(config)?.checked().map(drop))
}
