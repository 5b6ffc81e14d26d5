// loop.cpp: a fixed-rate loop around a LadsController, as a controller manager runs it: real-time scheduling where it is
// permitted, memory locked and touched beforehand, absolute deadlines, and an account of how they were kept.
//
//     loop IMAGE INSTRUCTION [CYCLES]
//
// The hardware is a stand-in: joints follow their velocity commands exactly. The exit status is 0 when every cycle ended with
// the policy's command and nothing was allocated in the loop, 1 when not, 2 when something was refused.
#include "lads_controller.hpp"

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstdlib>
#include <cstring>

#include <sched.h>
#include <sys/mman.h>
#include <time.h>

namespace {

std::atomic<unsigned long> allocations{0};

constexpr std::int64_t NS_PER_S = 1'000'000'000;

std::int64_t now_ns() {
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

void sleep_until(std::int64_t ns) {
    const timespec until{static_cast<time_t>(ns / NS_PER_S), static_cast<long>(ns % NS_PER_S)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr) == EINTR) {
    }
}

// Both are refused to ordinary users on many systems: then the loop still runs, only with worse timing.
void become_real_time() {
    sched_param parameters{};
    parameters.sched_priority = sched_get_priority_max(SCHED_FIFO) / 2;
    if (sched_setscheduler(0, SCHED_FIFO, &parameters) != 0) {
        std::printf("SCHED_FIFO: %s; the loop runs at normal priority\n", std::strerror(errno));
    }
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) {
        std::printf("mlockall: %s; pages may be swapped out\n", std::strerror(errno));
    }
}

// Touches the stack that the loop will use, so that no page fault is left for later.
void prefault_stack() {
    volatile unsigned char stack[LADS_STACK_BYTES + 64 * 1024];
    for (std::size_t i = 0; i < sizeof stack; i += 1024) {
        stack[i] = 0;
    }
}

// The stand-in for hardware: a state for every element of the observation, a command for every element of the action.
struct Hardware {
    std::vector<example::Interface> states, commands;
    // The state that a command moves; null for none.
    std::vector<example::Interface *> moved;
    std::vector<lads_element> limits;

    explicit Hardware(const lads::Policy &policy) {
        const lads_contract &contract = policy.contract();
        auto element = lads::made<lads_element>();
        for (std::size_t i = 0; i < contract.observation_len && policy.observation(i, element); ++i) {
            states.push_back({std::string(lads::view(element.name)), std::clamp(0.0F, element.min, element.max)});
            limits.push_back(element);
        }
        for (std::size_t i = 0; i < contract.action_len && policy.action(i, element); ++i) {
            commands.push_back({std::string(lads::view(element.name))});
            const auto same = [&](const lads_element &state) { return lads::view(state.joint) == lads::view(element.joint); };
            const auto found = std::find_if(limits.begin(), limits.end(), same);
            moved.push_back(found == limits.end() ? nullptr : &states[static_cast<std::size_t>(found - limits.begin())]);
        }
    }

    void write(double period_s) {
        for (std::size_t i = 0; i < commands.size(); ++i) {
            if (moved[i] != nullptr) {
                const lads_element &limit = limits[static_cast<std::size_t>(moved[i] - states.data())];
                const double wanted = moved[i]->value + commands[i].value * period_s;
                moved[i]->value = std::clamp(wanted, static_cast<double>(limit.min), static_cast<double>(limit.max));
            }
        }
    }
};

} // namespace

void *operator new(std::size_t bytes) {
    ++allocations;
    if (void *memory = std::malloc(bytes)) {
        return memory;
    }
    std::abort();
}
void operator delete(void *memory) noexcept { std::free(memory); }
void operator delete(void *memory, std::size_t) noexcept { std::free(memory); }

int main(int count, char **arguments) {
    if (count < 3) {
        std::fprintf(stderr, "usage: loop IMAGE INSTRUCTION [CYCLES]\n");
        return 2;
    }
    const long cycles = count > 3 ? std::strtol(arguments[3], nullptr, 10) : 100;

    // What a robot description would say, the stand-in takes from the policy itself.
    example::LadsController::Parameters parameters;
    parameters.image = arguments[1];
    parameters.instruction = arguments[2];
    std::ifstream file(parameters.image, std::ios::binary);
    const std::vector<char> bytes{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
    lads::Policy description;
    if (auto status = description.open({reinterpret_cast<const std::uint8_t *>(bytes.data()), bytes.size()}); !status) {
        std::fprintf(stderr, "loop: %s: %s\n", arguments[1], status.text());
        return 2;
    }
    Hardware hardware(description);

    example::LadsController controller;
    if (controller.on_configure(parameters, hardware.states, hardware.commands) != example::CallbackReturn::SUCCESS ||
        controller.on_activate() != example::CallbackReturn::SUCCESS) {
        return 2;
    }
    become_real_time();
    prefault_stack();

    const double period_s = static_cast<double>(description.contract().control_period_s);
    const auto period_ns = static_cast<std::int64_t>(std::llround(period_s * 1e9));
    const unsigned long before = allocations;
    std::int64_t deadline = now_ns(), latest_ns = 0, longest_ns = 0;
    long overruns = 0, errors = 0;
    for (long cycle = 0; cycle < cycles; ++cycle) {
        deadline += period_ns;
        sleep_until(deadline);
        const std::int64_t start = now_ns();
        latest_ns = std::max(latest_ns, start - deadline);
        // Cycles that have already gone by are skipped, not run late one after the other.
        const auto missed = static_cast<std::uint32_t>((start - deadline) / period_ns);
        deadline += missed * period_ns;
        overruns += missed;

        errors += controller.update(static_cast<std::uint64_t>(start), missed) == example::return_type::ERROR;
        longest_ns = std::max(longest_ns, now_ns() - start);
        hardware.write(period_s);
    }
    const unsigned long allocated = allocations - before;

    const lads_counters_t counters = controller.counters();
    std::printf("%ld cycles of %.1f ms: woken at most %.3f ms late, longest update %.3f ms, %ld periods missed\n", cycles,
                period_s * 1e3, static_cast<double>(latest_ns) * 1e-6, static_cast<double>(longest_ns) * 1e-6, overruns);
    std::printf("%llu of %llu commands are the policy's; %lu allocations in the loop\n",
                static_cast<unsigned long long>(counters.policy), static_cast<unsigned long long>(counters.periods), allocated);
    return errors > overruns || allocated != 0;
}
