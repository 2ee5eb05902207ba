//! try
use tandem_benches::*;
fn main() {
    let plan = harness::Plan {
        rounds: 20000,
        warm_up: 1000,
        cpus: [0, 1],
    };
    let k = clock::ns_per_tick();
    for (n, f) in [
        (
            "line",
            floor::cache_line as fn(&harness::Plan) -> std::io::Result<Vec<u32>>,
        ),
        ("crossbeam", peers::crossbeam_channel),
        ("rtrb", peers::rtrb),
        ("ioxps", peers::iceoryx2_pubsub),
        ("futex", floor::futex),
        ("eventfd", floor::eventfd),
        ("pipe", peers::pipe),
        ("unix", peers::unix_socket),
        ("mq", peers::message_queue),
        ("ioxev", peers::iceoryx2_event),
    ] {
        let mut s = f(&plan).unwrap();
        s.sort();
        let p = |q: f64| s[(s.len() as f64 * q) as usize] as f64 * k;
        println!(
            "{n} p50 {:.0} p99 {:.0} p99.9 {:.0} n {}",
            p(0.5),
            p(0.99),
            p(0.999),
            s.len()
        );
    }
}
