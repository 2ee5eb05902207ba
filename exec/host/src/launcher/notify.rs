//! What the datagrams of processes say.

use tandem_board::Instant;

use crate::supervisor::ProcessReport;

/// What a datagram holds.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Datagram {
    pub(super) reports: Vec<ProcessReport>,
    pub(super) status: Option<String>,
}

/// Reads the lines of a datagram. Lines that are unknown or wrong are left out.
pub(super) fn parse(bytes: &[u8], now: Instant) -> Datagram {
    let mut found = Datagram::default();
    let text = std::str::from_utf8(bytes).unwrap_or_default();
    let fields = || text.lines().filter_map(|line| line.split_once('='));
    let at = fields().find(|(name, _)| *name == "MONOTONIC_USEC");
    let at = at.and_then(|(_, us)| us.parse::<u64>().ok());
    let at = at.map_or(now, |us| Instant::from_ns(us.saturating_mul(1_000)));
    for field in fields() {
        found.reports.extend(match field {
            ("READY", "1") => Some(ProcessReport::Ready),
            ("WATCHDOG", "1") => Some(ProcessReport::Alive),
            ("STOPPING", "1") => Some(ProcessReport::Stopping),
            ("X_TANDEM_CHECKPOINT", number) => {
                let number = number.parse().ok();
                // A time of the future is not believed; the supervisor would wait for it.
                number.map(|number| ProcessReport::Checkpoint(number, at.min(now)))
            }
            ("STATUS", status) => {
                let printable = status.chars().filter(|it| !it.is_control());
                found.status = Some(printable.collect());
                None
            }
            _ => None,
        });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_datagram_are_reports_and_the_rest_is_left_out() {
        let now = Instant::from_ns(9_000_000);
        let text = b"READY=1\nSTATUS=is\x1b fine\nX_TANDEM_CHECKPOINT=7\nMONOTONIC_USEC=5\n\
            WATCHDOG=0\nWATCHDOG=1\nX_TANDEM_CHECKPOINT=x\nfoo";
        let found = parse(text, now);
        let reports = [
            ProcessReport::Ready,
            ProcessReport::Checkpoint(7, Instant::from_ns(5_000)),
            ProcessReport::Alive,
        ];
        assert_eq!(found.reports, reports);
        assert_eq!(found.status.as_deref(), Some("is fine"));
        let future = parse(b"X_TANDEM_CHECKPOINT=7\nMONOTONIC_USEC=99999999", now);
        assert_eq!(future.reports, [ProcessReport::Checkpoint(7, now)]);
        assert_eq!(parse(b"READY=1\n\xff", now), Datagram::default());
    }
}
