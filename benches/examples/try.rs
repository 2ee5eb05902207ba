//! try
use tandem_benches::*;
use tandem_shm::wait::WaitPolicy;
fn main() {
    let iso = tandem_board_host::isolation::enter().unwrap();
    println!("{iso:?}");
    let sys = tandem_board_host::BareSystem::power_on(&iso).unwrap();
    let plan = harness::Plan {
        rounds: 20000,
        warm_up: 1000,
        cpus: [0, 1],
    };
    let k = clock::ns_per_tick();
    let show = |n: &str, mut s: Vec<u32>| {
        s.sort();
        let p = |q: f64| s[(s.len() as f64 * q) as usize] as f64 * k;
        println!(
            "{n} p50 {:.0} p99 {:.0} p99.9 {:.0} n {}",
            p(0.5),
            p(0.99),
            p(0.999),
            s.len()
        );
    };
    for (n, f) in [
        (
            "line",
            floor::cache_line as fn(&harness::Plan) -> std::io::Result<Vec<u32>>,
        ),
        ("rtrb", peers::rtrb),
        ("ioxps", peers::iceoryx2_pubsub),
        ("futex", floor::futex),
        ("ioxev", peers::iceoryx2_event),
    ] {
        show(n, f(&plan).unwrap());
    }
    show(
        "tandem spin",
        tandem::sync(&sys, &plan, WaitPolicy::Spin).unwrap(),
    );
    show(
        "tandem sleep",
        tandem::sync(&sys, &plan, WaitPolicy::Sleep).unwrap(),
    );
    show(
        "tandem spin+sleep",
        tandem::sync(&sys, &plan, WaitPolicy::SpinThenSleep { spins: 200 }).unwrap(),
    );
}
